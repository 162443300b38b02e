"""Disk margins of the wired loop at the plant's input: gain and phase at once.

A factor f on the force of one coordinate, or one on each at once, keeps the loop stable if
f = (1 + a z) / (1 - a z) with any complex \\|z\\| < 1 and a = alpha / 2. alpha is the balanced
disk margin (Seiler, Packard, Gahinet, "An introduction to disk margins", IEEE Control Systems,
2020): the inverse of the largest \\|S - 1/2\\| over all frequencies, S being the sensitivity there.
Limits and noise are omitted. The controller's ``applied_force`` does not include the factor.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import RandomSource, ZeroOrderHold

from ffsm_drake.common.steps import step
from ffsm_drake.plugins.design.stability.linear_loop import LinearLoop, NotLinear
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.setup import BlockSetup

_PUSH = "push"  # the source of a force that acts beside the actuators'
_FREQUENCIES = 400  # at which the sensitivity is evaluated, besides those of the poles
_BALANCING = 30  # steps


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class DiskMargins:
    """Balanced disk margins; the smallest over postures of the planned motion."""

    names: tuple[str, ...]  # names of the driven coordinates
    alone: np.ndarray  # (n,) alpha of each force alone
    frequency: np.ndarray  # (n,) rad/s, at which it is critical
    together: float  # alpha that all forces tolerate at once, each with a factor of its own

    def gain(self, alpha: float) -> tuple[float, float]:
        """The range of real factors within a disk margin; the upper one may be infinite."""
        a = alpha / 2.0
        return (1.0 - a) / (1.0 + a), (1.0 + a) / (1.0 - a) if a < 1.0 else math.inf

    def phase(self, alpha: float) -> float:
        """The phase, rad, of the unit factors within a disk margin."""
        return 2.0 * math.atan(alpha / 2.0)

    def as_data(self) -> dict[str, Any]:
        """Plain data."""
        return dataclasses.asdict(self) | {
            "alone": self.alone.tolist(),
            "frequency": self.frequency.tolist(),
        }


@step("computing disk margins")
def disk_margins(scenario: Scenario) -> DiskMargins:
    """Disk margins from the grasp on, at five postures of the planned motion.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
      BlockError: a block cannot be linearised, or has another period than the controller.
    """
    with Linearizer(scenario, blocks={f"forces.{_PUSH}": force_beside}) as linearizer:
        loops, delay = linearizer.along(POSTURES), linearizer.given.actuation.delay
        driven = linearizer.coordinates.driven
    found = [_margins(loop, driven, delay) for loop in loops]
    worst = np.argmin([alone for alone, _, _ in found], axis=0)
    every = range(len(worst))
    return DiskMargins(
        names=tuple(np.array(loops[0].coordinates.names)[driven].tolist()),
        alone=np.array([found[k][0][i] for i, k in zip(every, worst, strict=True)]),
        frequency=np.array([found[k][1][i] for i, k in zip(every, worst, strict=True)]),
        together=min(together for _, _, together in found),
    )


def _margins(
    loop: LinearLoop, driven: np.ndarray, delay: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """alpha of each driven coordinate (n), where it is critical (n), rad/s, and that of all."""
    if len(loop.samples) > 1:
        raise NotLinear("disk margins need blocks that update with every control sample")
    if not loop.spectral_radius < 1.0:
        raise NotLinear("an unstable loop has no disk margins")
    frequencies = _grid(loop)
    shifted = np.array([_sensitivity(loop, w, driven, delay) for w in frequencies])
    shifted -= 0.5 * np.eye(shifted.shape[1])
    sizes = np.abs(np.diagonal(shifted, axis1=1, axis2=2))
    largest = sizes.argmax(axis=0)
    return 1.0 / sizes.max(axis=0), frequencies[largest], 1.0 / _largest_norm(shifted)


def _grid(loop: LinearLoop) -> np.ndarray:
    """Frequencies (m), rad/s, up to that of every second sample."""
    highest = math.pi / loop.sample_time
    poles = loop.poles[np.abs(loop.poles) > 1e-6]
    own = np.abs(np.angle(poles)) / loop.sample_time
    grid = np.concatenate([np.geomspace(1e-4 * highest, highest, _FREQUENCIES), own[own > 0.0]])
    return np.unique(np.minimum(grid, highest))


def _sensitivity(loop: LinearLoop, w: float, driven: np.ndarray, delay: int) -> np.ndarray:
    """Transfer matrix from a force beside the actuators' to the sum of both (n, n), driven
    coordinates, complex.
    """
    (sample,) = loop.samples
    push, z = loop.noise[_PUSH], np.exp(1j * w * loop.sample_time)
    columns, rows = sample.b[:, push][:, driven], sample.c[driven]
    response = np.linalg.solve(z * np.eye(len(sample.a)) - sample.a, columns)
    force = rows @ response + sample.d[driven][:, push][:, driven]
    return np.eye(len(rows)) + z ** (-delay) * force


def _largest_norm(matrices: np.ndarray) -> float:
    """The largest ``_balanced_norm`` of matrices (m, n, n); those that cannot have it are not
    balanced to the end.
    """
    largest = 0.0
    for k in np.argsort(-np.linalg.norm(matrices, 2, axis=(1, 2))):
        largest = max(largest, _balanced_norm(matrices[k], enough=largest))
    return largest


def _balanced_norm(matrix: np.ndarray, *, enough: float) -> float:
    """An upper bound on the structured singular value (n, n): the largest singular value of
    D M D^-1, D diagonal, found by Osborne's balancing, which ends once it is small ``enough``.
    """
    found, best = matrix.copy(), math.inf
    for _ in range(_BALANCING):
        best = min(best, float(np.linalg.norm(found, 2)))
        if best <= enough:
            break
        off = np.abs(found) ** 2
        np.fill_diagonal(off, 0.0)
        rows, columns = off.sum(axis=1), off.sum(axis=0)
        scale = np.where((rows > 0.0) & (columns > 0.0), (columns / np.maximum(rows, 1e-300)), 1.0)
        d = scale**0.25
        found = d[:, None] * found / d
    return best


def force_beside(setup: BlockSetup) -> Diagram:
    """A force that is white from sample to sample; no block receives it."""
    builder, size, period = DiagramBuilder(), setup.coordinates.num_velocities, setup.sample_time
    source = builder.AddNamedSystem(_PUSH, RandomSource(RandomDistribution.kGaussian, size, period))
    held = builder.AddNamedSystem("held", ZeroOrderHold(period, size))
    builder.Connect(source.get_output_port(), held.get_input_port())
    builder.ExportOutput(held.get_output_port(), "generalized_force")
    return builder.Build()
