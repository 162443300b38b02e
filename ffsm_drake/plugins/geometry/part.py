"""Signals and metrics of the true geometry: the hand's error that the controller does not know."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.so3 import composed, vector_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Signal, View
from ffsm_drake.systems.setup import BlockSetup

POSITION, ROTATION = "hand_position_error", "hand_rotation_error"
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


@dataclasses.dataclass(frozen=True, kw_only=True)
class DisplacedArm(Part):
    """The section ``effects.geometry``."""

    title = "Geometry"
    section = "Actuators"
    about = ""

    @classmethod
    def of(cls, scenario: Scenario) -> "DisplacedArm | None":
        """See Part."""
        return None if getattr(scenario.effects, "geometry", None) is None else cls()

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """The pose of the true hand seen from the one that the nominal model computes."""
        frame = setup.scenario.model.end_effector
        models = setup.craft.true(setup.grip), setup.craft.nominal(setup.grip)

        @functools.lru_cache(maxsize=1)
        def poses(key: bytes, size: int) -> tuple[np.ndarray, np.ndarray]:
            q = np.frombuffer(key).reshape(-1, size)
            true, nominal = (each.calc_frame_pose(q, frame) for each in models)
            return true, nominal

        def of_run(run: View) -> tuple[np.ndarray, np.ndarray]:
            size = len(run.coordinates.position_names)
            q = np.ascontiguousarray(run["state"][:, :size])
            return poses(q.tobytes(), size)

        def position(run: View) -> np.ndarray:
            true, nominal = of_run(run)
            return true[:, 4:] - nominal[:, 4:]

        def rotation(run: View) -> np.ndarray:
            true, nominal = of_run(run)
            return vector_of(composed(true[:, :4], nominal[:, :4] * _CONJUGATE))

        def signal(name: str, unit: str, meaning: str, of: Callable[[View], np.ndarray]) -> Signal:
            return Signal(
                name=name, unit=unit, meaning=meaning, components=("x", "y", "z"), of=of,
                heading=f"Geometry: {name.replace('_', ' ')}",
            )  # fmt: skip

        return (
            signal(POSITION, "m", "true minus nominal position of the hand, world axes", position),
            signal(
                ROTATION, "rad",
                "rotation vector from the nominal to the true attitude of the hand, world axes",
                rotation,
            ),
        )  # fmt: skip

    def metrics(self) -> Sequence[Metric]:
        """Largest errors of the hand in a run."""

        def largest(name: str, unit: str) -> Metric:
            def of(run: View) -> float:
                return float(np.linalg.norm(run[name], axis=1).max())

            return Metric(key=f"geometry.{name}", unit=unit, of=of)

        return largest(POSITION, "m"), largest(ROTATION, "rad")

    def sentence(self, figures: Sequence[Figure]) -> str:
        """See Part."""
        found: dict[str, Any] = by_key(figures)
        position, rotation = found[f"geometry.{POSITION}"], found[f"geometry.{ROTATION}"]
        return (
            f"geometry: the true hand is up to {position:.3g} m and {rotation:.3g} rad from the "
            "nominal one"
        )
