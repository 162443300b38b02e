"""Live replay of a record in Meshcat, with time slider, play, speed slider and quit."""

import time
import webbrowser

from pydrake.geometry import Meshcat

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.interrupts import interruptible
from ffsm_drake.plugins.interactive.controls import Controls
from ffsm_drake.plugins.interactive.door import keep_for_ever, live_server
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.show.meshcat.arrows import ARROW_KINDS, legend
from ffsm_drake.show.meshcat.replay_view import FRAMES_PER_SECOND, ReplayView, check_speed
from ffsm_drake.show.meshcat.stage import start_meshcat

PLAY, QUIT = "Play / pause (space)", "Quit (Esc)"
TIME, SPEED = "time [s]", "speed"
SLOWEST, FASTEST = 0.1, 10.0


class LiveReplay:
    """A record in Meshcat, advanced by ``step``.

    Moving the time slider pauses and shows that instant. At the end the replay pauses; playing
    again restarts it. With ``forces``, one button per arrow names its colour and toggles it.
    """

    def __init__(
        self,
        record: RunRecord,
        *,
        speed: float = 1.0,
        ghost: bool = True,
        path: bool = True,
        forces: bool = False,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Set the scene and add the controls. Arguments and errors as ``recording_html``."""
        check_speed(speed)
        self.meshcat = start_meshcat() if meshcat is None else meshcat
        self._view = ReplayView(self.meshcat, record, ghost=ghost, path=path, forces=forces)
        self._controls = Controls(self.meshcat)
        self._controls.add_button(PLAY, keycode="Space")
        resolution = record.scenario.sample_time
        self._controls.add_slider(
            TIME, low=0.0, high=max(self._view.duration, resolution), step=resolution, value=0.0
        )
        low, high = min(SLOWEST, speed), max(FASTEST, speed)
        self._controls.add_slider(SPEED, low=low, high=high, step=min(0.1, low), value=speed)
        self._arrow_buttons = legend(self._view.arrows) if self._view.arrows is not None else []
        self._visible = [True] * len(self._arrow_buttons)
        for label in self._arrow_buttons:
            self._controls.add_button(label)
        if self._view.magnified:  # Meshcat has no labels: a button that does nothing
            self._controls.add_button(f"[ {self._view.magnified} ]")
        self._controls.add_button(QUIT, keycode="Escape")
        self.time = 0.0  # s of the run
        self.playing = True

    def step(self, wall_dt: float) -> bool:
        """Apply the controls and advance by ``wall_dt`` (s); False once Quit was clicked."""
        if self._controls.clicked(QUIT):
            return False
        for i, label in enumerate(self._arrow_buttons):
            if self._controls.clicked(label):
                self._visible[i] = not self._visible[i]
                self.meshcat.SetProperty(ARROW_KINDS[i].path, "visible", self._visible[i])
        if self._controls.clicked(PLAY):
            self.playing = not self.playing
            if self.playing and self.time >= self._view.duration:
                self.time = 0.0
        if self._controls.moved(TIME):
            self.playing = False
            self.time = min(self._controls.value(TIME), self._view.duration)
            self._view.show(self.time)
        elif self.playing:
            self.time = min(self.time + self._controls.value(SPEED) * wall_dt, self._view.duration)
            self.playing = self.time < self._view.duration
            self._view.show(self.time)
            self._controls.set_value(TIME, self.time)
        return True

    def close(self) -> None:
        """Remove the controls; the scene stays."""
        self._controls.remove()


def replay_live(
    record: RunRecord,
    *,
    speed: float = 1.0,
    ghost: bool = True,
    path: bool = True,
    forces: bool = False,
    meshcat: Meshcat | None = None,
    open_browser: bool = False,
) -> None:
    """Replay a record in Meshcat until its Quit button is clicked or Ctrl-C is pressed.

    Args:
      record: the run.
      speed, ghost, path, forces: as in ``recording_html``; a slider changes the speed.
      meshcat: server to show it on; by default a new one behind a door (``door.live_server``),
        whose address is printed.
      open_browser: open the page in the default browser.

    Raises:
      FfsmError: the speed is not positive, or Drake's server fails.
      ModelError: the scenario's model no longer loads.
    """
    with live_server(meshcat) as (server, url):
        replay = LiveReplay(
            record, speed=speed, ghost=ghost, path=path, forces=forces, meshcat=server
        )
        if open_browser:
            webbrowser.open(url)
        try:
            _play(replay)
        except KeyboardInterrupt:
            replay.close()  # Ctrl-C, another way to quit
        except RuntimeError as error:
            keep_for_ever(server)
            raise FfsmError(f"the view is lost: {one_line(error)}") from error
        else:
            replay.close()


def _play(replay: LiveReplay) -> None:
    last = time.perf_counter()
    with interruptible():
        while replay.step((now := time.perf_counter()) - last):
            last = now
            time.sleep(1.0 / FRAMES_PER_SECOND)
