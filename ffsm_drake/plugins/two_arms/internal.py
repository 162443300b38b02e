"""The internal force of a closed chain, its control, and the wrenches of contacts in a motion."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import cross_of
from ffsm_drake.plugins.two_arms.chain import ClosedChain, Constraints
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.contacts import InternalForce
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import find_body
from ffsm_drake.systems.controllers.law import Sample


@dataclasses.dataclass(frozen=True, kw_only=True)
class InternalControl:
    """Integral action on the wrenches at the contacts; F (..., m) is its force on the target."""

    gain: float  # times the sample time
    preload: np.ndarray  # (m)
    is_least: bool  # the preload is that of a motion
    share: float | None  # of the target's load; None: the least of ``weight`` tau^2
    weight: np.ndarray  # (nv) of tau^2
    limit: np.ndarray  # (nv) of tau, N m or N; infinite: none
    target: Frame  # of its body
    # kg; centre of mass (3), m; inertia (3, 3) about the frame's origin, kg m^2; in its axes
    mass: np.ndarray
    center: np.ndarray
    inertia: np.ndarray

    @property
    def start(self) -> np.ndarray:
        """F (m) before the first sample, whose measured wrench has no preload yet."""
        return (1.0 - self.gain) * self.preload

    def step(self, chain: Constraints, sample: Sample, force: np.ndarray) -> np.ndarray:
        """F at the next sample, of the nominal chain."""
        if sample.contact_wrench is None:
            return force
        measured = sample.contact_wrench
        if not chain.is_spatial:
            measured = measured @ chain.wrench_map
        wanted = self.preload
        if self.share != 0.0:
            wanted = wanted + self.load(chain, sample.q_d, sample.v_d, sample.a_d)
        return force + self.gain * (wanted - measured)

    def check_preload(self, model: PlantModel, jacobians: np.ndarray) -> None:
        """Raise ScenarioError: at no time of a motion the limit of a joint allows the preload.

        A limited joint would let the integral grow without end.

        Args: the model of the chain; A (n, m, nv) at times of the motion.
        """
        held = np.abs(self.preload @ jacobians).min(axis=0)
        beyond = held - self.limit
        joint = int(np.argmax(beyond))
        if beyond[joint] < 1e-9:  # but for rounding on the base
            return
        name = model.coordinates.names[joint]
        unit = "N m" if model.coordinates.units[joint] == "rad" else "N"
        raise ScenarioError(
            "chain.force.preload",
            f"needs at least {held[joint]:.3g} {unit} of {name} at all times of the motion, and "
            f"its actuation.limit is {self.limit[joint]:.3g} {unit}; lower the preload, or raise "
            "the limit",
        )

    def load(self, chain: Constraints, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The wrenches (..., m) of the contacts on the target that move it along a motion, without
        the preload; configurations (..., nq), velocities and accelerations (..., nv).
        """
        if q.ndim > 1:
            return np.stack([self.load(chain, *one) for one in zip(q, v, a, strict=True)])
        if self.share is None:
            force = chain.model.calc_inverse_dynamics(q, v, a)
            return chain.least_wrench(q, force, self.weight)
        places = [each.grasp for each in chain.closures]
        return self.share * (self.whole_load(chain.model, q, v, a, places) @ chain.wrench_map)

    def whole_load(
        self,
        model: PlantModel,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        places: Sequence[Frame],
    ) -> np.ndarray:
        """The wrenches (6 for each place) that one hand at each place would need to move the
        target, in the axes of the place.
        """
        motion, R = (
            model.calc_frame_motion(q, v, a, self.target),
            model.calc_frame_rotation(q, self.target),
        )
        w, alpha, linear = motion[7:10], motion[13:16], motion[16:19]
        p, inertia = R @ self.center, R @ self.inertia @ R.T
        force = self.mass * (linear + cross_of(alpha, p) + cross_of(w, cross_of(w, p)))
        moment = inertia @ alpha + cross_of(w, inertia @ w) + self.mass * cross_of(p, linear)
        wrenches = []
        for place in places:
            arm = model.calc_frame_pose(q, place)[4:] - motion[4:7]
            turn = model.calc_frame_rotation(q, place).T
            wrenches += [turn @ (moment - cross_of(arm, force)), turn @ force]
        return np.concatenate(wrenches)


def internal_control(
    given: InternalForce, scenario: Scenario, chain: ClosedChain
) -> InternalControl:
    """The control of a scenario's internal force, in its nominal chain; without the preload that
    a motion determines.
    """
    model = chain.model
    body = find_body(model.plant, scenario.payload.body, key="payload.body")
    inertia = body.CalcSpatialInertiaInBodyFrame(model.context)
    preload = np.zeros(chain.constraints.size)
    if given.preload is not None and chain.loops:
        preload = np.tile(given.preload, len(chain.loops)) @ chain.constraints.wrench_map
    limit, share = force_limits(scenario, model.coordinates), given.share
    if share is None and not np.isfinite(limit[NUM_BASE_VELOCITIES:]).any():
        share = 0.0
    return InternalControl(
        gain=given.gain * scenario.sample_time,
        preload=preload,
        is_least=given.preload is None,
        share=share,
        weight=1.0 / squared_limits(limit),
        limit=limit,
        target=body.body_frame(),
        mass=np.array(inertia.get_mass()),
        center=inertia.get_com(),
        inertia=inertia.CalcRotationalInertia().CopyToFullMatrix3(),
    )


def planned_control(scenario: Scenario, chain: ClosedChain) -> InternalControl:
    """The control whose wrenches a motion has: without one, the least torque acts."""
    given = scenario.chain.force if scenario.chain.law == "minimal" else None
    control = internal_control(given or InternalForce(), scenario, chain)
    return control if given else dataclasses.replace(control, share=None)


def force_limits(scenario: Scenario, coordinates: Coordinates) -> np.ndarray:
    """``actuation.limit`` (nv), N m or N; infinite: none."""
    given = scenario.actuation.limit or {}
    return coordinates.vector(given, key="actuation.limit", default=np.inf)


def squared_limits(limit: np.ndarray) -> np.ndarray:
    """Squares of limits (nv) as parts of the largest; 1 without a limit."""
    largest = limit[np.isfinite(limit)].max(initial=1.0)
    squares: np.ndarray = np.where(np.isfinite(limit), limit / largest, 1.0) ** 2
    return squares
