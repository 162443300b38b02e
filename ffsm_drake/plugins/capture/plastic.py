"""The grasp of a moving target as a plastic impact: final velocities, impulses, lost energy.

With v of the servicer and V = [w_WP; v_WP] of the target's frame P, world axes, the impulse G
on the target at P gives

    M_s v+ = M_s v - J^T G + S^T g,    M_T V+ = M_T V + G,    V+ = J v+,

with J the Jacobian of P as a point of the arm, and g the impulses of the brakes (S picks the braked
joints, S v+ = 0). Without brakes M_c v+ = M_s v + J^T M_T V, with M_c = M_s + J^T M_T J,
the mass matrix with the target held. Finite forces have no effect in an instant, so momentum is
conserved exactly, and v+ has the least energy of all motions with this momentum (and with the
braked joints at rest).
"""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.spacecraft.grasp import Grasp, plastic_impact

_RANK = 1e-9  # of the mobility of the hands beside brakes, of its largest singular value


def plastic_grasp(
    *,
    mass_matrix: np.ndarray,
    jacobian: np.ndarray,
    target_inertia: np.ndarray,
    velocity: np.ndarray,
    target_velocity: np.ndarray,
    braked: Sequence[int] = (),
    constraints: np.ndarray | None = None,
) -> Grasp:
    """The plastic grasp; see the module docstring.

    Args:
      mass_matrix: M_c (nv, nv) of the servicer with the target in its grasp.
      jacobian: J (6, nv), [w_WP; v_WP] = J v of the target's frame P in the grasp, world axes.
      target_inertia: M_T (6, 6), the target's spatial inertia about P, world axes.
      velocity: v (nv) of the servicer before.
      target_velocity: V (6), [w_WP; v_WP] of the target before.
      braked: indices of the joints in v that brakes stop; the base, v[:6], has none.
      constraints: A (m, nv) of further hands that grasp in the same instant, A v+ = 0. Where
        brakes stop the joints that move them, the brakes have the impulses.
    """
    if any(not 6 <= index < velocity.size for index in braked):
        raise ValueError(
            f"braked: joints of v have the indices 6 to {velocity.size - 1}, not {list(braked)}"
        )
    # M_T times the target's relative velocity
    change = target_inertia @ (target_velocity - jacobian @ velocity)
    p = mass_matrix @ velocity + jacobian.T @ change
    brakes = np.zeros_like(velocity)
    if braked:
        after, brakes[list(braked)] = _braked(mass_matrix, p, list(braked), constraints)
    else:
        after = velocity + np.linalg.solve(mass_matrix, jacobian.T @ change)
        if constraints is not None:
            after, _ = plastic_impact(mass_matrix, constraints, after)
    target_momentum = target_inertia @ target_velocity
    held = target_inertia @ (jacobian @ velocity)  # momentum of a target moving with the arm
    return Grasp(
        velocity=after,
        impulse=target_inertia @ (jacobian @ after) - target_momentum,
        brake_impulse=brakes,
        energy_before=0.5
        * float(
            velocity @ mass_matrix @ velocity
            - (jacobian @ velocity) @ held
            + target_velocity @ target_momentum
        ),
        energy_after=0.5 * float(after @ mass_matrix @ after),
        momentum_before=(mass_matrix @ velocity)[:6] + jacobian[:, :6].T @ (target_momentum - held),
        momentum_after=(mass_matrix @ after)[:6],
    )


def _braked(
    mass_matrix: np.ndarray, momentum: np.ndarray, braked: list[int], constraints: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """The velocity (nv) with a momentum (nv) and joints at rest, and the impulses of the brakes."""
    free = np.setdiff1d(np.arange(momentum.size), braked)
    among, after = mass_matrix[np.ix_(free, free)], np.zeros_like(momentum)
    after[free] = np.linalg.solve(among, momentum[free])
    if constraints is not None:  # of the motion that the brakes allow
        inverse = np.linalg.solve(among, constraints[:, free].T)
        inner, missing = constraints[:, free] @ inverse, -constraints @ after
        impulses = np.linalg.lstsq(inner, missing, rcond=_RANK)[0]
        after[free] += inverse @ impulses
        momentum = momentum + impulses @ constraints
    return after, (mass_matrix @ after - momentum)[braked]
