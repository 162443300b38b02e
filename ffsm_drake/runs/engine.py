"""Choice of what computes a run: Drake, or a plug-in's engine by name."""

from collections.abc import Collection, Sequence
from typing import Any

from ffsm_drake.common.errors import FfsmError, choices
from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.registry import Factory

DRAKE = "drake"
FAILS = "the run fails or diverges"


class NotCovered(FfsmError):
    """An engine does not compute a spacecraft, a law or a run."""

    def __init__(self, what: str) -> None:
        super().__init__(f"engine: not covered: {what}; use the engine {DRAKE}")
        self.what = what


class Engine:
    """Computes whole runs; plug-ins derive from it (``ENGINES``)."""

    name: str
    batch = 64  # usual number of runs at once

    def check(self, scenario: Scenario) -> None:
        """Raise NotCovered for a scenario whose settings show that it is not covered."""

    def run_all(
        self, missions: Sequence[Mission], signals: Collection[str] | None = None
    ) -> Sequence[Any]:
        """Return the log (``RunLog``) of each run. In its place, NotCovered: it is not computed;
        None: it fails or diverges, so that Drake's run shows how.

        ``signals``: those that the logs need; None: all.
        """
        raise NotImplementedError

    def lanes(self, mission: Mission, factory: Factory, number: int, samples: int) -> Any:
        """Return runs whose law, of a factory, is given actions between the samples.

        Args: the mission, the law's factory, the number of runs, the most samples of an action.

        Raises NotCovered.
        """
        raise NotCovered("actions of an agent")


# By name; a class is made without arguments.
ENGINES = Registry[type[Engine]]("engines")


def on_drake(found: NotCovered | None) -> str:
    """Return the engine in the log of a run that Drake computes for another engine, which returned
    this in its place.
    """
    return f"{DRAKE} ({FAILS if found is None else f'not covered: {found.what}'})"


def find_engine(name: str) -> Engine | None:
    """Return the engine of a name; None: Drake.

    Raises:
      FfsmError: the name is unknown, or the engine needs a package that is not installed.
      BlockError: the plug-in cannot be loaded.
    """
    if name == DRAKE:
        return None
    known = [DRAKE, *ENGINES.offers()]
    if name not in known:
        raise FfsmError(f"engine: '{name}' is unknown; choose one of {choices(name, known)}")
    return ENGINES.load(name, "engine")()
