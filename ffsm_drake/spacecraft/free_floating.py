"""Free floating: motion of an undriven base by conservation of momentum.

Some of the velocities v are driven (a), the others are not (u): the whole base, or only its
position. Then

    H_uu v_u + H_ua v_a = p_u

with the mass matrix H and the momentum p_u. This gives v_u, generalized Jacobians, H* and the
reaction null space (``docs/how_a_free_base_moves.md``). World axes throughout; twists are [w; v],
rad/s and m/s, as Drake has them. Momenta are [angular about the world's origin; linear], N m s and
N s: constant without external forces.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ffsm_drake.common.products import applied, condensed, product
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel

_RANK = 1e-9  # ratio of singular values: above rounding errors, below that of any arm
_BASE = Coordinates((), ())
_POSITION = slice(4, NUM_BASE_POSITIONS)  # p_WB in q

Task = Literal["pose", "attitude", "position"]
# rows of a twist
TASK_ROWS: dict[str, slice] = {
    "pose": slice(0, 6),
    "attitude": slice(0, 3),
    "position": slice(3, 6),
    "none": slice(0, 0),
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FreeFloating:
    """Kinematics and dynamics of an underactuated spacecraft in one or many configurations.

    ``free_floating`` makes it from a model. Arrays have the shape (...,) of the configurations and
    then their own. Results are kept for further calls.

    Example:
      >>> import numpy as np
      >>> from ffsm_drake import free_floating, load_scenario, make_true_plant
      >>> model = make_true_plant(load_scenario("postcapture"))
      >>> q = np.array([1.0, *np.zeros(11)])
      >>> free_floating(model, q).momentum_map.shape
      (6, 11)
    """

    mass_matrix: np.ndarray  # H (..., nv, nv)
    base_position: np.ndarray  # p_WB (..., 3), m
    driven: np.ndarray  # (na) indices of v, ascending

    @functools.cached_property
    def undriven(self) -> np.ndarray:
        """Indices (nu) of the undriven v."""
        return np.delete(np.arange(self.mass_matrix.shape[-1]), self.driven)

    @functools.cached_property
    def momentum_map(self) -> np.ndarray:
        """Momentum matrix A (..., 6, nv), momentum = A v, with moments about the world's origin."""
        rows = self.mass_matrix[..., :NUM_BASE_VELOCITIES, :].copy()
        rows[..., :3, :] += np.cross(self.base_position[..., :, None], rows[..., 3:, :], axis=-2)
        return rows

    @functools.cached_property
    def center_of_mass(self) -> np.ndarray:
        """p_BC (..., 3), from the base's origin, world axes, m."""
        return center_of_mass(self.mass_matrix)

    @functools.cached_property
    def spin_map(self) -> np.ndarray:
        """Matrix (..., 3, nv) from v to the angular momentum about the centre of mass, world axes.

        Its first three columns are the inertia about the centre of mass with the joints held, the
        next three are zero.
        """
        turning, moving = (
            self.mass_matrix[..., :3, :],
            self.mass_matrix[..., 3:NUM_BASE_VELOCITIES, :],
        )
        return turning - np.cross(self.center_of_mass[..., None], moving, axis=-2)

    @functools.cached_property
    def following(self) -> np.ndarray:
        """-H_uu^-1 H_ua (..., nu, na): undriven velocities per driven one, at zero momentum."""
        rows = self.mass_matrix[..., self.undriven, :]
        return -np.linalg.solve(rows[..., self.undriven], rows[..., self.driven])

    def velocity(
        self, driven_velocity: np.ndarray, momentum: np.ndarray | None = None
    ) -> np.ndarray:
        """All velocities v (..., nv) from the driven ones: v_u = H_uu^-1 (p_u - H_ua v_a).

        Args:
          driven_velocity: v_a (..., na), rad/s and m/s.
          momentum: total momentum (..., 6); None: zero.

        Raises ValueError unless base or base position are undriven: other coordinates do not follow
        from momentum.
        """
        self._check_conserved()
        following = applied(self.following, driven_velocity)
        if momentum is not None:
            about_base = np.array(
                np.broadcast_to(momentum, (*self.base_position.shape[:-1], 6)), dtype=float
            )
            about_base[..., :3] -= np.cross(self.base_position, about_base[..., 3:])
            own = self.mass_matrix[..., self.undriven[:, None], self.undriven]
            following = (
                following + np.linalg.solve(own, about_base[..., self.undriven, None])[..., 0]
            )
        v = np.empty((*following.shape[:-1], self.mass_matrix.shape[-1]))
        v[..., self.undriven], v[..., self.driven] = following, driven_velocity
        return v

    def momentum(self, v: np.ndarray) -> np.ndarray:
        """Return the momentum (..., 6) of velocities v (..., nv)."""
        return applied(self.momentum_map, v)

    def generalized_jacobian(self, jacobian: np.ndarray) -> np.ndarray:
        """J* = J_a - J_u H_uu^-1 H_ua (..., m, na): a frame's twist is J* v_a plus its ``drift``.

        Args:
          jacobian: J (..., m, nv), see ``PlantModel.calc_jacobian``.

        Raises: the errors of ``velocity``.
        """
        self._check_conserved()
        return jacobian[..., self.driven] + product(jacobian[..., self.undriven], self.following)

    def drift(self, jacobian: np.ndarray, momentum: np.ndarray) -> np.ndarray:
        """J_u H_uu^-1 p_u (..., m): a frame's twist with the driven coordinates at rest.

        Args:
          jacobian: J (..., m, nv).
          momentum: (..., 6).

        Raises: the errors of ``velocity``.
        """
        return applied(jacobian, self.velocity(np.zeros(self.driven.size), momentum))

    @functools.cached_property
    def reduced_mass_matrix(self) -> np.ndarray:
        """H* = H_aa - H_au H_uu^-1 H_ua (..., na, na) of H* dv_a/dt + C* = tau_a."""
        rows = self.mass_matrix[..., self.driven, :]
        return rows[..., self.driven] + product(rows[..., self.undriven], self.following)

    def reduced_bias(self, bias: np.ndarray) -> np.ndarray:
        """C* = C_a - H_au H_uu^-1 C_u (..., na), N m and N, of the bias C (..., nv) of
        ``PlantModel.calc_bias``.
        """
        across = np.swapaxes(self.following, -1, -2)
        return bias[..., self.driven] + applied(across, bias[..., self.undriven])

    def bias_acceleration(
        self, jacobian: np.ndarray, frame_bias: np.ndarray, bias: np.ndarray
    ) -> np.ndarray:
        """J' v - J_u H_uu^-1 C_u (..., m): a frame's [alpha; a] less J* dv_a/dt, for any tau_a.

        Args: J (..., m, nv); J' v (..., m) of ``PlantModel.calc_bias_acceleration``; C (..., nv) of
        ``calc_bias``.
        """
        own = self.mass_matrix[..., self.undriven[:, None], self.undriven]
        following = np.linalg.solve(own, bias[..., self.undriven, None])[..., 0]
        return frame_bias - applied(jacobian[..., self.undriven], following)

    def reaction_null_space(self, held: Sequence[str] = ("base_rotation",)) -> np.ndarray:
        """Projector N (..., na, na): at zero momentum v_a = N z keeps the held coordinates at rest.

        N is symmetric, and N z is the nearest such velocity to z; N = 0 if there is none. Its rank
        is na less the number of independent held rows of ``following``.

        Args:
          held: groups or names of undriven base coordinates.

        Raises: ValueError for other names, and the errors of ``velocity``.
        """
        self._check_conserved()
        rows = np.flatnonzero(np.isin(self.undriven, _BASE.indices(held, key="held")))
        if rows.size < len(_BASE.indices(held, key="held")):
            raise ValueError(f"held: {', '.join(held)} is driven, so no reaction moves it")
        _, sizes, directions = np.linalg.svd(self.following[..., rows, :])
        kept = sizes > _RANK * sizes.max(axis=-1, keepdims=True, initial=0.0)
        directions = directions[..., : sizes.shape[-1], :] * kept[..., None]
        return np.eye(self.driven.size) - np.swapaxes(directions, -1, -2) @ directions

    def _check_conserved(self) -> None:
        if self.undriven.tolist() not in ([0, 1, 2, 3, 4, 5], [3, 4, 5], []):
            raise ValueError(
                "undriven coordinates follow from momentum only if they are the whole base or its "
                "position"
            )


def center_of_mass(mass_matrix: np.ndarray) -> np.ndarray:
    """Return p_BC (..., 3) of H (..., nv, nv), from the base's origin, world axes, m."""
    # its velocity from w is w x p_BC
    return mass_matrix[..., [4, 5, 3], [2, 0, 1]] / mass_matrix[..., 3, 3, None]


def free_floating(
    model: PlantModel, q: np.ndarray, driven: Sequence[str] = ("joints",)
) -> FreeFloating:
    """Return the underactuated spacecraft of a model in some configurations.

    Args:
      model: the spacecraft with its payload.
      q: configurations (..., nq).
      driven: names of driven coordinates or groups; ("base_rotation", "joints") for a base with
        controlled attitude and free position.

    Raises:
      ScenarioError: a name is unknown.
      ValueError: the plant has flexible parts, or q is not finite.

    Example:
      >>> import numpy as np
      >>> from ffsm_drake import free_floating, load_scenario, make_true_plant
      >>> model = make_true_plant(load_scenario("postcapture"))
      >>> floating = free_floating(model, np.array([1.0, *np.zeros(11)]), driven=("joints",))
      >>> floating.driven.tolist()
      [6, 7, 8, 9, 10]
    """
    if model.split.names:
        raise ValueError("the plant has flexible parts, moved by springs; use a plant without")
    return FreeFloating(
        mass_matrix=model.calc_mass_matrix(q),
        base_position=q[..., _POSITION],
        driven=model.coordinates.indices(driven, key="driven"),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReducedModel(PlantModel):
    """A control law's model of an underactuated plant (``coordinates.undriven``).

    Its mass matrix holds H* and its bias C* in the rows and columns of the driven coordinates, and
    a decoupled unit mass without bias in the others. ``calc_jacobian`` is still the whole plant's.
    """

    # The formulas of FreeFloating, fast enough for every control sample.

    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """H* and ones (..., nv, nv) in configurations q (..., nq)."""
        return self._reduced(super().calc_mass_matrix(q))

    def calc_apparent_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """As PlantModel: H* of the apparent mass matrix."""
        return self._reduced(super().calc_apparent_mass_matrix(q))

    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """C* and zeros (..., nv), N m and N, for velocities v (..., nv)."""
        whole = super().calc_bias(q, v)
        H = super().calc_mass_matrix(q)
        driven, undriven = self._parts
        rows = H[..., undriven, :]
        following = np.linalg.solve(rows[..., undriven], whole[..., undriven, None])[..., 0]
        result = np.zeros_like(whole)
        result[..., driven] = whole[..., driven] - applied(rows[..., driven].mT, following)
        return result

    @functools.cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the driven and of the undriven coordinates."""
        return self.coordinates.driven, np.flatnonzero(~self.coordinates.is_driven)

    def _reduced(self, whole: np.ndarray) -> np.ndarray:
        driven, undriven = self._parts
        result = np.zeros_like(whole)
        result[..., undriven, undriven] = 1.0
        result[..., driven[:, None], driven] = condensed(whole, driven, undriven)
        return result


def driven_model(model: PlantModel) -> PlantModel:
    """Return a control law's model of the plant: a ReducedModel if it is underactuated, else
    itself.
    """
    if not model.coordinates.undriven:
        return model
    # a model of a plug-in has its own
    return _made(getattr(model, "reduced", ReducedModel), model)


def whole_model(model: PlantModel) -> PlantModel:
    """Return the model of which ``driven_model`` made one."""
    return _made(type(model).__bases__[-1], model) if isinstance(model, ReducedModel) else model


def _made(kind: Any, model: PlantModel) -> Any:
    """Return a model of a kind with the fields of another."""
    return kind(**{each.name: getattr(model, each.name) for each in dataclasses.fields(model)})
