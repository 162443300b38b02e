"""Backlash in flexible gears, at every stage of the integrator.

The spring of a gear with the stiffness k gives no torque while its angle d is within the gap 2 b
(dead band; M. Nordin and P.-O. Gutman, Automatica 38, 2002, equation of the exact model without the
memory of its damper). The plant has the spring -k d, and this force adds k clip(d, -b, b).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ffsm_drake.plugins.flexible.backlash_settings import Backlash
from ffsm_drake.plugins.flexible.bodies import spring_stiffness
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import HIDDEN
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import STEPS, Signal, View
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup

IN_GAP = "in_gap"


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeadBand(Continuous):
    """The force that takes the spring of gears away within their gaps.

    Input: ``hidden_state`` [angles; rates] (2 nh), rad and rad/s.
    Outputs: ``generalized_force`` (nv) of zero, ``hidden_force`` (nh), N m.
    """

    half: np.ndarray  # (nh) half the gap, rad; 0: none
    stiffness: np.ndarray  # (nh) N m/rad
    num_velocities: int

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"hidden_state": 2 * self.half.size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"generalized_force": self.num_velocities, "hidden_force": self.half.size}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        angle = inputs["hidden_state"][: self.half.size]
        within = np.minimum(np.maximum(angle, -self.half), self.half)
        force = self.stiffness * within
        return {"generalized_force": np.zeros(self.num_velocities), "hidden_force": force}, {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class GearBacklash(Part):
    """The section ``effects.backlash``."""

    title = "Backlash"
    section = "Flexible parts"
    about = ""
    settings: Backlash

    @classmethod
    def of(cls, scenario: Scenario) -> "GearBacklash | None":
        """See Part."""
        settings = getattr(scenario.effects, "backlash", None)
        return None if settings is None else cls(settings=settings)

    def build(self, setup: BlockSetup) -> DeadBand:
        """See Part."""
        names, model = setup.split.names, setup.craft.flexible(setup.grip)
        found = spring_stiffness(model.plant, model.context)
        gaps = self.settings.gap
        return DeadBand(
            half=np.array([0.5 * gaps.get(name, 0.0) for name in names]),
            stiffness=np.array([found.get(f"{HIDDEN}{name}", 0.0) for name in names]),
            num_velocities=len(setup.coordinates.names),
        )

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Whether each gear is within its gap."""
        gaps, names = self.settings.gap, setup.split.names
        places = [names.index(name) for name in gaps]
        half = 0.5 * np.array([*gaps.values()])

        def free(run: View) -> np.ndarray:
            return (np.abs(run["hidden_state"][:, places]) < half) * 1.0

        return (
            Signal(
                name=IN_GAP, unit="1", meaning="whether a gear is within its gap, without contact",
                components=tuple(gaps), dimension="gear", chart=STEPS, of=free,
                heading="Backlash: within the gap",
            ),
        )  # fmt: skip

    def metrics(self) -> Sequence[Metric]:
        """Share of the samples within the gap, and number of contacts, by gear."""

        def of_gears(key: str, calc: Callable[[np.ndarray], np.ndarray]) -> Metric:
            def of(run: View) -> dict[str, float]:
                found = calc(run[IN_GAP].reshape(len(run.time), -1))
                return dict(zip(self.settings.gap, found.tolist(), strict=True))

            return Metric(key=f"backlash.{key}", unit="1", column="", of=of)

        return of_gears("in_gap", _share), of_gears("contacts", _contacts)


def _share(free: np.ndarray) -> np.ndarray:
    """Share of the samples within the gap, from signals (samples, n)."""
    return np.asarray(free.mean(axis=0))


def _contacts(free: np.ndarray) -> np.ndarray:
    """Number of times that a gear leaves its gap, from signals (samples, n)."""
    return np.asarray((np.diff(free, axis=0) < 0.0).sum(axis=0))
