"""Buttons and sliders of a Meshcat page, and what the operator did with them."""

from pydrake.geometry import Meshcat


class Controls:
    """The controls that one user of a Meshcat page has added to it; ``remove`` takes them away again."""

    def __init__(self, meshcat: Meshcat) -> None:
        self._meshcat = meshcat
        self._clicks: dict[str, int] = {}
        self._values: dict[str, float] = {}

    def add_button(self, label: str, *, keycode: str = "") -> None:
        """Add a button; ``keycode`` is a JavaScript key code that clicks it."""
        self._clicks[label] = 0  # first, so that an interrupt between the two leaves nothing behind
        self._meshcat.AddButton(label, keycode)

    def add_slider(self, label: str, *, low: float, high: float, step: float, value: float) -> None:
        """Add a slider from low to high."""
        self._values[label] = self._meshcat.AddSlider(label, low, high, step, value)

    def clicked(self, label: str) -> bool:
        """Whether the button was clicked since this was last asked."""
        clicks = self._meshcat.GetButtonClicks(label)
        news = clicks != self._clicks[label]
        self._clicks[label] = clicks
        return news

    def value(self, label: str) -> float:
        """The slider's value."""
        return float(self._meshcat.GetSliderValue(label))

    def moved(self, label: str) -> bool:
        """Whether the operator moved the slider since this was last asked."""
        value = self.value(label)
        news = value != self._values[label]
        self._values[label] = value
        return news

    def set_value(self, label: str, value: float) -> None:
        """Move the slider from here: ``moved`` does not report it."""
        self._values[label] = self._meshcat.SetSliderValue(label, value)

    def remove_button(self, label: str) -> None:
        """Take one button away if it is there."""
        self._meshcat.DeleteButton(label, strict=False)
        self._clicks.pop(label, None)

    def remove(self) -> None:
        """Take all controls away."""
        for label in [*self._clicks]:
            self.remove_button(label)
        for label in self._values:
            self._meshcat.DeleteSlider(label, strict=False)
        self._values = {}
