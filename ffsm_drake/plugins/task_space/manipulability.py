"""Dynamic manipulability and singularities of a frame of a spacecraft without base forces."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from pydrake.multibody.tree import Frame
from scipy.optimize import minimize_scalar

from ffsm_drake.spacecraft.free_floating import TASK_ROWS, Task, free_floating
from ffsm_drake.spacecraft.nominal import PlantModel


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Manipulability:
    """Manipulability of a frame, from generalized (..., m, na) or fixed-base Jacobians."""

    singular_values: np.ndarray  # (..., k), the largest first; k is the smaller of m and na
    lost: np.ndarray  # (..., m) twist direction of the smallest one

    @property
    def measure(self) -> np.ndarray:
        """sqrt(det(J* J*^T)) (...), the product of the singular values; J*^T J* if na < m."""
        return self.singular_values.prod(axis=-1)

    @property
    def smallest(self) -> np.ndarray:
        """The smallest singular value (...): zero at a dynamic singularity."""
        return self.singular_values[..., -1]


def manipulability(
    jacobian: np.ndarray, *, task: Task = "pose", length: float = 1.0
) -> Manipulability:
    """Return the dynamic manipulability of a generalized Jacobian J* (..., 6, na).

    Args:
      task: rows of the Jacobian: of the twist [w; v], of w, or of v.
      length: characteristic length, m, that makes w comparable to v: w counts as length w.
    """
    scaled = (np.repeat([length, 1.0], 3)[:, None] * jacobian)[..., TASK_ROWS[task], :]
    left, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    return Manipulability(singular_values=sizes, lost=left[..., -1])


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Singularity:
    """A local closest approach of a motion to a dynamic singularity."""

    time: float  # s
    smallest: float  # singular value
    # (m) twist direction that then takes the largest rates, length w for w
    lost: np.ndarray


def manipulability_along(
    model: PlantModel,
    positions: np.ndarray,
    frame: Frame | str,
    *,
    driven: Sequence[str] = ("joints",),
    task: Task = "pose",
    length: float = 1.0,
) -> Manipulability:
    """Return the dynamic manipulability of a frame along a motion, configurations (n, nq).

    The base's pose does not matter. Arguments and errors as ``free_floating``,
    ``PlantModel.calc_jacobian`` and ``manipulability``.
    """
    spacecraft = free_floating(model, positions, driven)
    jacobian = spacecraft.generalized_jacobian(model.calc_jacobian(positions, frame))
    return manipulability(jacobian, task=task, length=length)


def singularities_along(
    model: PlantModel,
    positions: Callable[[np.ndarray], np.ndarray],
    times: np.ndarray,
    frame: Frame | str,
    *,
    below: float,
    driven: Sequence[str] = ("joints",),
    task: Task = "pose",
    length: float = 1.0,
) -> list[Singularity]:
    """Minima over time of a motion's smallest singular value that lie below a bound.

    Args:
      positions: configurations (n, nq) at times (n,), s, such as the first columns of
        ``Plan.rows``.
      times: ascending; each minimum is then refined to 1e-9 of their spacing.
      below: bound on the singular value.
      others: as ``manipulability_along``.
    """

    def at(some: np.ndarray) -> Manipulability:
        return manipulability_along(
            model, positions(some), frame, driven=driven, task=task, length=length
        )

    size = np.concatenate([[np.inf], at(times).smallest, [np.inf]])
    found = []
    for index in np.flatnonzero((size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:])).tolist():
        first, last = times[max(index - 1, 0)], times[min(index + 1, len(times) - 1)]
        inner = minimize_scalar(
            lambda time: float(at(np.array([time])).smallest[0]),
            bounds=(first, last),
            method="bounded",
            options={"xatol": 1e-9 * (last - first)},
        )
        time = float(inner.x) if inner.fun < size[index + 1] else float(times[index])
        here = at(np.array([time]))
        if here.smallest[0] < below:
            found.append(
                Singularity(time=time, smallest=float(here.smallest[0]), lost=here.lost[0])
            )
    return found
