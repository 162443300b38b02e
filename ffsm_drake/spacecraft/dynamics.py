"""Computation of the motion of copies of the spacecraft: Drake's plant, or a plug-in by name."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from ffsm_drake.common.errors import FfsmError, choices
from ffsm_drake.common.plugins import DYNAMICS, load, offered
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.copies import Copies, CopiesModel, copies_of
from ffsm_drake.spacecraft.nominal import PlantModel

DRAKE = "drake"
_ELSE_DRAKE = f"_else_{DRAKE}"


class NotCovered(FfsmError):
    """Dynamics of a plug-in do not compute this spacecraft, or this run."""

    def __init__(self, what: str) -> None:
        super().__init__(
            f"dynamics: not covered: {what}; a name that ends in {_ELSE_DRAKE} leaves such runs to "
            "Drake"
        )


class Dynamics:
    """Drake's plant; plug-ins derive others from it (entry point group ``DYNAMICS``)."""

    name = DRAKE
    batch: int | None = None  # usual number of runs side by side; None: see ``usual_batch``
    runs_whole = False  # whether ``run_all`` computes all of a run, not its plant alone

    def check(self, scenario: Scenario) -> None:
        """Raise NotCovered for a run that these dynamics do not compute."""

    def copies(self, model: Model, number: int) -> Copies:
        """Return the true spacecraft, with its flexible parts. Raises ModelError, NotCovered."""
        return Copies.of(model, number, flexible=True)

    def models(self, models: Sequence[PlantModel], scenario: Scenario) -> CopiesModel:
        """Return the models of several laws as one; arguments as ``copies_of``."""
        return copies_of(models, scenario)

    def run_all(self, scenarios: Sequence[Scenario]) -> Sequence[Any]:
        """Return, of dynamics that compute whole runs, the log (``RunLog``) of each run. In its
        place, NotCovered: it is not computed; None: it fails or diverges, so
        that Drake's run shows how.
        """
        raise NotCovered(f"whole runs with {self.name}")


class Chosen(NamedTuple):
    """Dynamics by name, and their rule for runs beyond their coverage."""

    dynamics: Dynamics
    else_drake: bool  # Drake computes it; else it is refused


def find_dynamics(name: str) -> Chosen:
    """Return the dynamics of a name: ``drake``, or a plug-in's, such as ``generated``, or with
    ``generated_else_drake`` Drake's for the runs that it does not cover.

    Raises:
      FfsmError: the name is unknown.
      BlockError: the plug-in cannot be loaded.
    """
    own = name.removesuffix(_ELSE_DRAKE)
    if name == DRAKE:
        return Chosen(Dynamics(), False)
    if own not in offered(DYNAMICS):
        known = dynamics_names()
        raise FfsmError(f"dynamics: '{name}' is unknown; choose one of {choices(name, known)}")
    made: Any = load(DYNAMICS, own, "dynamics")
    return Chosen(made(), own != name)


def dynamics_names() -> list[str]:
    """Return the names that ``find_dynamics`` accepts."""
    others = (each for name in offered(DYNAMICS) for each in (name, name + _ELSE_DRAKE))
    return [DRAKE, *others]
