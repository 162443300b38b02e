"""Names of the generalized velocities, and the difference of two configurations.

Gains, disturbances, noise and reports address coordinates by name or by group. Their order is
Drake's, v = [w_WB, v_WB, joint rates]; only this module depends on it.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint

from ffsm_drake.common.errors import ScenarioError, choices, some
from ffsm_drake.common.so3 import rotation_error, rotation_error_rate, times_conjugate, vector_of

BASE_ROTATION = ("base_rotation_x", "base_rotation_y", "base_rotation_z")
BASE_POSITION = ("base_position_x", "base_position_y", "base_position_z")
BASE_QUATERNION = (
    "base_quaternion_w",
    "base_quaternion_x",
    "base_quaternion_y",
    "base_quaternion_z",
)
GROUPS = ("base_rotation", "base_position", "joints")
# Names of the joints of hidden coordinates (``model.flexible``) begin with it.
HIDDEN = "flexible."

NUM_BASE_POSITIONS = 7  # quaternion (w, x, y, z) of R_WB, then p_WB
NUM_BASE_VELOCITIES = 6  # w_WB, v_WB, both in the world frame


def joints_of(plant: MultibodyPlant) -> list[Joint]:
    """Return the joints of a finalized plant with one degree of freedom, in the order of v."""
    joints = map(plant.get_joint, plant.GetJointIndices())
    return sorted(
        (joint for joint in joints if joint.num_velocities() == 1),
        key=lambda joint: joint.velocity_start(),
    )


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """The generalized velocities v of a floating-base arm, by name: base rotation, base position,
    joints.
    """

    joints: tuple[str, ...]
    joint_units: tuple[str, ...]  # "rad" or "m", one per joint
    undriven: tuple[str, ...] = ()  # groups that no actuator moves
    # joints that only the true plant has, for errors
    flexible: tuple[str, ...] = dataclasses.field(default=(), compare=False)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Names of v, in Drake's order (nv)."""
        return BASE_ROTATION + BASE_POSITION + self.joints

    @functools.cached_property
    def position_names(self) -> tuple[str, ...]:
        """Names of q, in Drake's order (nv + 1: the rotation is a quaternion)."""
        return BASE_QUATERNION + BASE_POSITION + self.joints

    @functools.cached_property
    def num_velocities(self) -> int:
        """nv."""
        return len(self.names)

    @functools.cached_property
    def num_positions(self) -> int:
        """nq."""
        return len(self.position_names)

    @functools.cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each coordinate (nv): "rad" or "m"."""
        return ("rad",) * 3 + ("m",) * 3 + self.joint_units

    @property
    def groups(self) -> dict[str, slice]:
        """Group name -> its slice of v."""
        return {
            "base_rotation": slice(0, 3),
            "base_position": slice(3, 6),
            "joints": slice(6, len(self.names)),
        }

    @property
    def driven_groups(self) -> dict[str, slice]:
        """``groups`` without the undriven ones."""
        return {group: part for group, part in self.groups.items() if group not in self.undriven}

    @functools.cached_property
    def is_driven(self) -> np.ndarray:
        """Mask (nv) of the coordinates that actuators move."""
        return np.array([group not in self.undriven for group in self.group_of])

    @functools.cached_property
    def driven(self) -> np.ndarray:
        """Indices of v that actuators move (na), ascending."""
        return np.flatnonzero(self.is_driven)

    @functools.cached_property
    def group_of(self) -> tuple[str, ...]:
        """Group of each coordinate (nv)."""
        return tuple(group for group, part in self.groups.items() for _ in self.names[part])

    def vector(
        self, values: Mapping[str, float], *, key: str, default: float | None = None
    ) -> np.ndarray:
        """Return the vector (nv) from a mapping by ``all``, group or coordinate name.

        A coordinate's own name overrides its group, a group overrides ``all``; ``default`` is for
        coordinates not mentioned. Raises ScenarioError, naming ``key``, for an unknown name or a
        coordinate without a value.
        """
        if not values and default is not None:
            return np.full(len(self.names), float(default))
        self.check_names(values, key=key)
        result = [
            values.get(name, values.get(group, values.get("all", default)))
            for name, group in zip(self.names, self.group_of, strict=True)
        ]
        missing = [name for name, value in zip(self.names, result, strict=True) if value is None]
        if missing:
            raise ScenarioError(
                key, f"gives no value for {some(missing)}; add them, their group, or 'all'"
            )
        return np.array(result, dtype=float)

    def by_name(self, values: np.ndarray) -> dict[str, float]:
        """Return a vector (nv) as a mapping by coordinate name."""
        return dict(zip(self.names, values.tolist(), strict=True))

    def joint_vector(self, values: Mapping[str, float], *, key: str, default: float) -> np.ndarray:
        """Same as ``vector``, for joints only: keys are ``all`` or joint names. Raises
        ScenarioError.
        """
        self._check(values, ("all", "joints", *self.joints), key, "is not a joint")
        return self.vector(values, key=key, default=default)[NUM_BASE_VELOCITIES:]

    def indices(self, names: Iterable[str], *, key: str) -> np.ndarray:
        """Return the indices in v, ascending, of groups and coordinates. Raises ScenarioError for
        others.
        """
        wanted = dict.fromkeys(names)
        self.check_names(wanted, key=key)
        both = zip(self.names, self.group_of, strict=True)
        return np.flatnonzero([not wanted.keys().isdisjoint((*each, "all")) for each in both])

    def check_names(self, names: Mapping[str, object], *, key: str) -> None:
        """Raise ScenarioError if a key is not ``all``, a group or a coordinate."""
        self._check(names, ("all", *GROUPS, *self.names), key, "unknown coordinate")

    def _check(self, names: Iterable[str], valid: tuple[str, ...], key: str, fault: str) -> None:
        """Raise ScenarioError for a name that is not valid."""
        for name in names:
            if name in valid:
                continue
            problem = f"{fault}; valid here: {choices(name, valid)}"
            if name in self.flexible:
                problem = "is a flexible joint (model.flexible), at rest at zero; leave it out"
            raise ScenarioError(f"{key}.{name}", problem)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StateSplit:
    """The known state [q; v] and the hidden state [q_h; v_h] as parts of the true plant's state.

    Hidden from the controller are the coordinates of flexible parts; without any, the whole state
    is known. Shapes: (..., size of the state).
    """

    names: tuple[str, ...] = ()  # names of the hidden coordinates
    units: tuple[str, ...] = ()  # "rad" or "m", one per hidden coordinate
    # Indices in the plant's [q; v] of the entries of the known and of the hidden state.
    known_state: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, dtype=int))
    hidden_state: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, dtype=int))
    # The same in the plant's v.
    known: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, dtype=int))
    hidden: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, dtype=int))

    def whole(self, state: np.ndarray, hidden_state: np.ndarray | None = None) -> np.ndarray:
        """Return the plant's [q; v] from known and hidden states; hidden default: zero."""
        if not self.names:
            return state
        size = self.known_state.size + self.hidden_state.size
        result = np.zeros_like(state, shape=(*state.shape[:-1], size))
        result[..., self.known_state] = state
        if hidden_state is not None:
            result[..., self.hidden_state] = hidden_state
        return result

    def whole_positions(self, q: np.ndarray, hidden: np.ndarray | None = None) -> np.ndarray:
        """Return the plant's q from known and hidden positions; hidden default: zero."""
        if not self.names:
            return q
        known = np.concatenate([q, np.zeros_like(q[..., 1:])], axis=-1)
        at_rest = None if hidden is None else np.concatenate([hidden, np.zeros_like(hidden)])
        return self.whole(known, at_rest)[..., : q.shape[-1] + len(self.names)]

    def whole_velocities(self, v: np.ndarray) -> np.ndarray:
        """Return the plant's v from known velocities (nv); the hidden ones are zero."""
        if not self.names:
            return v
        result = np.zeros_like(v, shape=v.size + len(self.names))
        result[self.known] = v
        return result

    def known_part(self, state: np.ndarray) -> np.ndarray:
        """Return the known state in the plant's [q; v]."""
        return state[..., self.known_state] if self.names else state

    def hidden_part(self, state: np.ndarray) -> np.ndarray:
        """Return the hidden state in the plant's [q; v]."""
        return state[..., self.hidden_state]

    def known_velocities(self, v: np.ndarray) -> np.ndarray:
        """Return the known part of vectors along the plant's v."""
        return v[..., self.known] if self.names else v

    def whole_names(self, known: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the plant's velocities from the names of the known ones."""
        places = [*self.known.tolist(), *self.hidden.tolist()]
        named = dict(zip(places or range(len(known)), (*known, *self.names), strict=True))
        return tuple(named[i] for i in sorted(named))


def halves(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q (nq) and v (nv) of a state [q; v], also of symbols."""
    first = (len(state) + 1) // 2  # the quaternion has one entry more than the rotation vector
    return state[:first], state[first:]


def position_error(q_d: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the tracking error e (nv) from configuration q to q_d: rotation vector (world), then
    differences.
    """
    error = np.empty(q.size - 1)
    error[:3] = rotation_error(q_d[:4], q[:4])
    np.subtract(q_d[4:], q[4:], out=error[3:])
    return error


def error_rate(error: np.ndarray, v_d: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the rate (nv) of a tracking error, for velocities v_d and v (nv):
    ``rotation_error_rate``, then differences.
    """
    rate = v_d - v
    rate[:3] = rotation_error_rate(tuple(error[:3].tolist()), v_d[:3], v[:3])
    return rate


def tracking_errors(
    desired: np.ndarray, actual: np.ndarray, num_positions: int
) -> tuple[np.ndarray, np.ndarray]:
    """``position_error`` and ``error_rate`` (nv each) from states [q; v] (nq + nv)."""
    error = position_error(desired[:num_positions], actual[:num_positions])
    return error, error_rate(error, desired[num_positions:], actual[num_positions:])


def position_errors(q_d: np.ndarray, q: np.ndarray) -> np.ndarray:
    """``position_error`` of many configurations at once: (n, nq) each -> (n, nv)."""
    turn = np.stack(times_conjugate(q_d[:, :4].T, q[:, :4].T), axis=1)
    return np.hstack([vector_of(turn), q_d[:, 4:] - q[:, 4:]])
