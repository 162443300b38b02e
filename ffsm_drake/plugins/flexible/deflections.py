"""Signals and metrics of the hidden coordinates of the true spacecraft (``model.flexible``): their
deflection, the energy of their springs, and the residual vibration after the planned motion.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from ffsm_drake.common.numbers import usable
from ffsm_drake.plugins.flexible.steps import check_steps
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import STORED_ENERGY, Constant, Signal, View
from ffsm_drake.systems.setup import BlockSetup

_AT_REST = 1e-9  # rad/s or m/s; below any planned motion
# Name of the columns in campaigns, by the unit of the coordinates.
_COLUMNS = {"rad": "angle", "m": "distance"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Deflections(Part):
    """Hidden coordinates, of parts of some kinds (``scenario.FLEXIBLE_KINDS``)."""

    title = "Flexible parts"
    section = "Flexible parts"
    about = "Motion of the flexible parts, which the controller's model treats as rigid."
    kinds: tuple[str, ...]

    @classmethod
    def of(cls, scenario: Scenario) -> "Deflections | None":
        """The deflections of a scenario."""
        kinds = tuple(part.kind for part in scenario.model.flexible.values())
        return cls(kinds=kinds) if kinds else None

    def check_plant(self, scenario: Scenario, model: PlantModel) -> None:
        """Raise ScenarioError if the integrator's steps are unstable for a flexible mode."""
        check_steps(scenario, model)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Positions, rates, forces; the energy of springs, and what dampers took."""
        hidden = setup.split
        along = functools.partial(Signal, components=hidden.names, dimension="hidden_coordinate")
        units = dict(zip(hidden.names, hidden.units, strict=True))
        return (
            along(
                name="hidden_position",
                unit="rad or m",
                meaning="deflection of a flexible part, unknown to the controller",
                heading="Deflection",
                panels=units,
                of=_position,
            ),
            along(
                name="hidden_velocity",
                unit="rad or m per s",
                meaning="rate of the deflection of a flexible part",
                heading="Rate",
                panels={name: f"{unit}/s" for name, unit in units.items()},
                of=lambda run: np.split(run["hidden_state"], 2, axis=1)[1],
            ),
            Signal(
                name="elastic_energy",
                unit="J",
                meaning="energy of the springs of flexible parts",
                heading="Energy",
                panel="Energy of the springs",
                role=STORED_ENERGY,
                of=_elastic_energy,
            ),
            Signal(
                name="damping_loss",
                unit="J",
                meaning="energy dissipated by the dampers of flexible parts since the start",
                heading="",
                role=STORED_ENERGY,
                of=_damping_loss,
            ),
            along(
                name="hidden_force",
                unit="N m or N",
                meaning="sum of the external forces on a flexible part at this instant",
                heading="",
                of=_force,
            ),
        )

    def constants(self, setup: BlockSetup) -> Sequence[Constant]:
        """Units of the deflections."""
        return [
            Constant(
                name="hidden_unit",
                unit="",
                meaning="unit of the deflection of a flexible part",
                dimension="hidden_coordinate",
                values=setup.split.units,
            )
        ]

    def metrics(self) -> Sequence[Metric]:
        """The largest deflection by coordinate; amplitude and rms after the reference has come to
        rest, if before the run's last sample; and the largest over all coordinates of a unit.
        """
        units = tuple(
            dict.fromkeys("m" if kind in ("mass", "beam") else "rad" for kind in self.kinds)
        )
        by_name = (
            ("peak", "Largest deflection of flexible parts", peak, _position),
            ("residual_amplitude", "Their amplitude after the motion", amplitude, residual),
            ("residual_rms", "Their rms after the motion", rms, residual),
        )
        return (
            *(
                Metric(
                    key=f"hidden.{key}",
                    unit=unit,
                    label=label,
                    column="",
                    of=functools.partial(_by_name, of, when, unit),
                )
                for key, label, of, when in by_name
                for unit in units
            ),
            Metric(key="hidden.residual_since", unit="s", column="", of=_since),
            *(
                Metric(
                    key="",
                    unit=unit,
                    column=f"{column}_{_COLUMNS[unit]}",
                    heading=f"{heading} [{unit}]",
                    of=functools.partial(_largest, of, when, unit),
                )
                for unit in units
                for column, heading, of, when in (
                    ("peak_deflection", "peak deflection", peak, _position),
                    ("residual", "residual amplitude", amplitude, residual),
                )
            ),
        )

    def sentence(self, figures: Sequence[Figure]) -> str:
        """Peak and residual deflections."""

        def listed(key: str) -> str:
            return ", ".join(
                f"{name} {value:.3g} {figure.unit}"
                for figure in figures
                if figure.key == f"hidden.{key}"
                for name, value in by_key([figure])[figure.key].items()
            )

        line = f"flexible parts: deflected by at most {listed('peak')}"
        since = by_key(figures)["hidden.residual_since"]
        if not math.isnan(since):
            line += (
                f"; after the motion, from t = {since:g} s, amplitude "
                f"{listed('residual_amplitude')}, rms {listed('residual_rms')}"
            )
        return line


def first_at_rest(velocity: np.ndarray) -> int:
    """The sample from which a reference's velocity (n, nv) stays zero; n where it does not."""
    moving = np.flatnonzero((np.abs(velocity) > _AT_REST).any(axis=1))
    return int(moving[-1]) + 1 if moving.size else 0


def peak(deflection: np.ndarray) -> np.ndarray:
    """The largest of each (n, nh)."""
    return np.abs(deflection).max(axis=0)


def amplitude(deflection: np.ndarray) -> np.ndarray:
    """Half the distance from the least to the largest of each (n, nh)."""
    return np.ptp(deflection, axis=0) / 2.0


def rms(deflection: np.ndarray) -> np.ndarray:
    """Root of the mean square about the mean of each (n, nh)."""
    return deflection.std(axis=0)


def residual(run: View) -> np.ndarray | None:
    """The deflections (m, nh) after the reference has come to rest; None if it does not before the
    last sample.
    """
    first = _first(run)
    return _position(run)[first:] if first < len(run.time) - 1 else None


def _first(run: View) -> int:
    return first_at_rest(run["desired_state"][:, len(run.coordinates.position_names) :])


def _since(run: View) -> float | None:
    first = _first(run)
    return float(run.time[first]) if first < len(run.time) - 1 else None


def _position(run: View) -> np.ndarray:
    return np.split(run["hidden_state"], 2, axis=1)[0]


def _force(run: View) -> np.ndarray | None:
    """N m or N (n, nh); None if no force acts on them."""
    if "external_hidden_force" not in run:
        return None
    return run["external_hidden_force"]


def _by_name(
    of: Callable[[np.ndarray], np.ndarray],
    when: Callable[[View], np.ndarray | None],
    unit: str,
    run: View,
) -> dict[str, float | None]:
    """A figure of the coordinates with a unit."""
    deflection, hidden = when(run), run.split
    values = [None] * len(hidden.names) if deflection is None else of(deflection).tolist()
    named = zip(hidden.names, hidden.units, values, strict=True)
    return {name: value for name, other, value in named if other == unit}


def _largest(
    of: Callable[[np.ndarray], np.ndarray],
    when: Callable[[View], np.ndarray | None],
    unit: str,
    run: View,
) -> float | None:
    values = [value for value in _by_name(of, when, unit, run).values() if value is not None]
    return float(np.max(values)) if values else None


def _elastic_energy(run: View) -> np.ndarray:
    """J (n)."""
    model = run.model
    states = run.split.whole(run["state"], run["hidden_state"])
    elastic = np.full(len(states), np.nan)
    for i in np.flatnonzero(usable(states)):  # not a diverged run's last: Drake ends the process
        model.plant.SetPositionsAndVelocities(model.context, states[i])
        elastic[i] = model.plant.CalcPotentialEnergy(model.context)
    return elastic


def _damping_loss(run: View) -> np.ndarray:
    """J (n); the mean square of a rate that is quadratic within a sample follows from its ends and
    from how far it went.
    """
    plant, context = run.model.plant, run.model.context
    states = run.split.whole(run["state"], run["hidden_state"])
    joints = [
        joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.num_velocities() == 1
    ]
    damping = np.array([joint.GetDampingVector(context)[0] for joint in joints])
    angle = states[:, [joint.position_start() for joint in joints]]
    rate = states[:, [plant.num_positions() + joint.velocity_start() for joint in joints]]
    period = run.scenario.sample_time
    before, after = rate[:-1], rate[1:]
    bow = 6.0 * np.diff(angle, axis=0) / period - 3.0 * (before + after)
    square = (
        (before**2 + before * after + after**2) / 3.0 + bow * (before + after) / 6.0 + bow**2 / 30.0
    )
    return np.concatenate([np.zeros(1), np.cumsum(period * square @ damping)])
