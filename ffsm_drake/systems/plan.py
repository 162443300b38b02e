"""A plan: a motion as a cubic spline, in a small text file written by ``ffsm plan``.

The curve is z(t) = [phi, p_WB, joints], with the base turned by exp(phi), a cubic B-spline on
[0, duration] with segments of any length. A plan may end with small rates; these then
die away over ``settle``. q_d, v_d and dv_d/dt are computed from z, z' and z'', so each is the
exact derivative of the one before.
"""

import dataclasses
import functools
from pathlib import Path

import numpy as np
from pydrake.math import BsplineBasis
from pydrake.trajectories import BsplineTrajectory

from ffsm_drake.common.errors import ScenarioError, one_line
from ffsm_drake.common.files import check_regular, write_text
from ffsm_drake.common.so3 import attitude_motion, turned_by
from ffsm_drake.scenario import StrictYamlError, read_yaml, write_yaml
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.plant import resolve_package

DEGREE = 3
_MAX_SIZE = 1_000_000  # bytes
_KEYS = ("duration", "settle", "first_attitude", "coordinates", "control_points")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """A planned motion; at rest after ``duration + settle``."""

    duration: float  # s; the spline's
    settle: float  # s; time for the rates at its end to die away; 0 if they are zero
    first_attitude: tuple[float, float, float, float]  # quaternion (w, x, y, z) of R_0
    coordinates: tuple[str, ...]  # names of z, which are those of v (nv)
    knots: np.ndarray  # (segments + 1,), between segments, as shares of the duration: 0 to 1
    control_points: np.ndarray  # (segments + 3, nv), rad and m

    @property
    def end(self) -> float:
        """Time at which the motion comes to rest, s."""
        return self.duration + self.settle

    @functools.cached_property
    def _curves(self) -> tuple[BsplineTrajectory, ...]:
        """z as a function of t / duration, and its derivatives."""
        points = np.asfortranarray(self.control_points.T)
        knots = np.r_[np.zeros(DEGREE), self.knots, np.ones(DEGREE)]
        basis = BsplineBasis(DEGREE + 1, knots.tolist())
        curve = BsplineTrajectory(basis, [column[:, None] for column in points.T])
        rate = curve.MakeDerivative()
        return curve, rate, rate.MakeDerivative()

    def curve(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """z and its first and second time derivative (nv, n) at times (n,), s."""
        share = np.clip(times / self.duration, 0.0, 1.0)
        z, rate, acceleration = (
            curve.vector_values(share) / self.duration**order
            for order, curve in enumerate(self._curves)
        )
        after = times > self.duration
        last = rate[:, after]
        if self.settle > 0.0:
            u = np.minimum((times[after] - self.duration) / self.settle, 1.0)
            z[:, after] += last * self.settle * (u - u**3 + 0.5 * u**4)
            rate[:, after] = last * (1.0 - 3.0 * u**2 + 2.0 * u**3)
            acceleration[:, after] = last / self.settle * 6.0 * (u**2 - u)
        else:
            rate[:, after] = acceleration[:, after] = 0.0
        return z, rate, acceleration

    def instants(self, per_segment: int) -> np.ndarray:
        """Times that divide each segment, and ``settle``, into a number of equal parts (n,), s."""
        marks = np.r_[self.duration * self.knots, [self.end] * (self.settle > 0.0)]
        count = len(marks) - 1
        parts = np.linspace(0.0, count, count * per_segment + 1)
        return np.interp(parts, np.arange(count + 1), marks)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,), s."""
        z, rate, acceleration = self.curve(times)
        _, w, alpha = attitude_motion(z[:3], rate[:3], acceleration[:3])
        quaternion = turned_by(z[:3].T, np.array(self.first_attitude)).T
        return np.vstack([quaternion, z[3:], w, rate[3:], alpha, acceleration[3:]]).T

    def save(self, path: Path, *, title: str) -> None:
        """Write it as text, to the last bit. Raises RecordError if the file cannot be written."""
        data = {
            "duration": self.duration,
            "settle": self.settle,
            "first_attitude": list(self.first_attitude),
            "coordinates": list(self.coordinates),
            "knots": self.knots.tolist(),
        }
        rows = "".join(f"- [{', '.join(map(repr, row))}]\n" for row in self.control_points.tolist())
        head = "".join(f"# {line}\n" for line in title.splitlines())
        text = write_yaml(data, width=120, default_flow_style=None)
        write_text(path, f"{head}{text}control_points:\n{rows}")


def load_plan(address: str, coordinates: Coordinates) -> Plan:
    """Read a plan.

    Args:
      address: a path or package:// address.
      coordinates: the spacecraft's, which the plan must match.

    Raises:
      ScenarioError: it cannot be read, or is for other coordinates.
    """
    key = "reference.plan"
    path = resolve_package(address)
    try:
        check_regular(path, limit=_MAX_SIZE)
        data = read_yaml(path.read_text(encoding="utf-8"))
        missing = [name for name in _KEYS if name not in data]
        if missing:
            raise ValueError(f"lacks {', '.join(missing)}")
        w, x, y, z = map(float, data["first_attitude"])
        points = np.array(data["control_points"], dtype=float)
        plan = Plan(
            duration=float(data["duration"]),
            settle=float(data["settle"]),
            first_attitude=(w, x, y, z),
            coordinates=tuple(map(str, data["coordinates"])),
            # before they were written, segments were equally long
            knots=np.array(data.get("knots", np.linspace(0.0, 1.0, len(points) - DEGREE + 1))),
            control_points=points,
        )
        _check(plan)
    except FileNotFoundError:
        raise ScenarioError(key, f"{path}: no such file; 'ffsm plan' writes it") from None
    except (OSError, ValueError, TypeError, StrictYamlError) as error:
        raise ScenarioError(
            key, f"{path}: is not a plan: {one_line(error)}; let 'ffsm plan' write it"
        ) from error
    if plan.coordinates != coordinates.names:
        raise ScenarioError(
            key,
            f"{path}: is a plan for {', '.join(plan.coordinates)}, not for "
            f"{', '.join(coordinates.names)}",
        )
    return plan


def _check(plan: Plan) -> None:
    """Raise ValueError unless the numbers form a plan."""
    points, knots = plan.control_points, plan.knots
    sound = (
        points.ndim == 2
        and points.shape == (len(knots) - 1 + DEGREE, len(plan.coordinates))
        and len(knots) > 1
        and np.isfinite(points).all()
        and (knots[0], knots[-1]) == (0.0, 1.0)
        and (np.diff(knots) > 0.0).all()
        and abs(np.linalg.norm(plan.first_attitude) - 1.0) < 1e-6
    )
    if not sound:
        raise ValueError("its numbers do not form a valid plan")
    if not (0.0 < plan.duration < np.inf and 0.0 <= plan.settle < np.inf):
        raise ValueError("its duration is not > 0 s")
