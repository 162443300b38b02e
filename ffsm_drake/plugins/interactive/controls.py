"""Buttons and sliders of a Meshcat page, their state, and a lock for them."""

import secrets
from collections.abc import Callable

from pydrake.geometry import Meshcat


def label_text(text: str) -> str:
    """Text made safe for a label: Meshcat pastes labels into a script, between single quotes."""
    return " ".join(text.replace("\\", "/").replace("'", "\N{RIGHT SINGLE QUOTATION MARK}").split())


class Controls:
    """A set of controls on a Meshcat page; ``remove`` removes them all."""

    def __init__(self, meshcat: Meshcat) -> None:
        self._meshcat = meshcat
        self._clicks: dict[str, int] = {}
        self._values: dict[str, float] = {}

    def add_button(self, label: str, *, keycode: str = "") -> None:
        """Add a button; ``keycode`` is a JavaScript key code that clicks it."""
        self._clicks[label] = 0  # first, for ``remove`` after an interrupt between the two
        self._meshcat.AddButton(label, keycode)

    def add_slider(self, label: str, *, low: float, high: float, step: float, value: float) -> None:
        """Add a slider from low to high."""
        self._values[label] = self._meshcat.AddSlider(label, low, high, step, value)

    def clicked(self, label: str) -> bool:
        """True if the button was clicked since the last call."""
        clicks = self._meshcat.GetButtonClicks(label)
        news = clicks != self._clicks[label]
        self._clicks[label] = clicks
        return news

    def all_clicked(self) -> set[str]:
        """The buttons clicked since the last call."""
        return {label for label in self._clicks if self.clicked(label)}

    def value(self, label: str) -> float:
        """The slider's value."""
        return float(self._meshcat.GetSliderValue(label))

    def moved(self, label: str) -> bool:
        """True if the operator moved the slider since the last call."""
        value = self.value(label)
        news = value != self._values[label]
        self._values[label] = value
        return news

    def set_value(self, label: str, value: float) -> None:
        """Move the slider by program: ``moved`` does not report it."""
        self._values[label] = self._meshcat.SetSliderValue(label, value)

    def remove_button(self, label: str) -> None:
        """Remove a button, if it exists."""
        self._meshcat.DeleteButton(label, strict=False)
        self._clicks.pop(label, None)

    def remove(self) -> None:
        """Remove all controls."""
        for label in [*self._clicks]:
            self.remove_button(label)
        for label in self._values:
            self._meshcat.DeleteSlider(label, strict=False)
        self._values = {}


CODE, UNLOCK = "code", "Unlock the controls"
_DIGITS = 5  # digits of a number that the panel can show
_TRIES = 3


class CodeLock:
    """A lock for a page's controls; the code passed to ``tell`` opens it.

    Drake's server does not check origins: any connected page can send commands and sees the code
    during entry. So a code works once, and only while a single page is connected; when
    another joins or that one leaves, the lock closes with a new code. After three wrong codes it
    stays closed.
    """

    def __init__(self, meshcat: Meshcat, tell: Callable[[str], None]) -> None:
        """Args: the page's Meshcat; a function called with each line for the terminal."""
        self._meshcat, self._tell = meshcat, tell
        self._controls = Controls(meshcat)
        self._tries = _TRIES
        self._pages = 0  # number of pages when it was opened
        self.is_open = False
        self._close("")

    def check(self) -> bool:
        """Poll the page; True if the lock is open now."""
        pages = self._meshcat.GetNumActiveConnections()
        if self.is_open:
            if pages != self._pages:
                self._close("A page has joined or left, so the controls are locked. ")
        elif self._tries and self._controls.clicked(UNLOCK):
            right = self._controls.value(CODE) == self._code
            self.remove()
            if right and pages <= 1:
                self.is_open, self._pages = True, pages
                self._tell("The controls are unlocked.")
            elif right:
                self._close("More than one page is connected: close the others. ")
            else:
                self._tries -= 1
                self._close("That was another code. ")
        return self.is_open

    def remove(self) -> None:
        """Remove the lock's own controls."""
        self._controls.remove()

    def _close(self, why: str) -> None:
        self.is_open = False
        if not self._tries:
            self._tell(f"{why}The controls stay locked until ffsm is started anew.")
            return
        self._code = 10 ** (_DIGITS - 1) + secrets.randbelow(9 * 10 ** (_DIGITS - 1))
        self._controls.add_slider(CODE, low=0, high=10**_DIGITS - 1, step=1, value=0)
        self._controls.add_button(UNLOCK)
        self._tell(
            f"{why}To unlock the controls, type {self._code} beside '{CODE}' and click '{UNLOCK}'."
        )
