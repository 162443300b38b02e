"""The whole closed loop against one written again from the paper, on MuJoCo, sharing nothing with
the package.

Plant, nominal model, reference, disturbance, the four laws and the integrator are stated here a
second time, position first as in the paper; only the gains are read from the scenario. See
mujoco_oracle for the coordinates.
"""

import abc
import functools
import types
from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco_oracle as oracle
import numpy as np
import pytest
from numpy.testing import assert_array_less
from scipy.spatial.transform import Rotation

from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Scenario, load_scenario
from ffsm_drake.systems.controllers import complete_gains

pytestmark = pytest.mark.rounding

# Table 1 of the paper.
DURATION = 20.0  # s
PERIOD = 0.01  # s, the controller's period and delay L
COMPARED = 12.0  # s, past the fastest part of the motion
START_POSITION, START_RPY = np.array([0.1, 0.3, -0.2]), np.array([0.11, 0.08, -0.1])
TARGET_POSITION, TARGET_RPY = np.zeros(3), np.zeros(3)
START_JOINTS = np.radians([10, 20, 60, 35, -40])
TARGET_JOINTS = np.radians([-25, 65, 50, 65, -25])

NAMES = (
    *("base_position_x", "base_position_y", "base_position_z"),
    *("base_rotation_x", "base_rotation_y", "base_rotation_z"),
    *(f"joint_{i}" for i in range(1, 6)),
)
GROUPS = ("base_position",) * 3 + ("base_rotation",) * 3 + ("joints",) * 5


def disturbance(t: float) -> np.ndarray:
    """tau_d of Table 1 (11): external force on the base, torque on the base, joint torques."""
    base = [0.4 * np.sin(0.3 * t), 0.3 * np.cos(0.1 * t), 0.2 * np.sin(0.3 * t)]
    arm = [
        0.1 * np.sin(1.2 * t),
        0.08 * np.sin(0.1 * t) + 0.1,
        -0.1 * np.sin(0.6 * t),
        0.09 * np.sin(0.8 * t + np.pi / 4) - 0.1,
        0.1 * np.cos(t) + 0.1,
    ]
    return np.array([*base, *base, *arm])


@functools.cache
def quintic() -> np.polynomial.Polynomial:
    """The fifth-order polynomial in t from 0 to 1 over DURATION, at rest and without acceleration
    at both ends.
    """
    powers = np.arange(6)
    conditions = [
        [
            factor * x ** float(max(power - order, 0))
            for power, factor in zip(powers, factors, strict=True)
        ]
        for x in (0.0, 1.0)
        for order, factors in enumerate((np.ones(6), powers, powers * (powers - 1)))
    ]
    return np.polynomial.Polynomial(
        np.linalg.solve(conditions, [0, 0, 0, 1, 0, 0]) / DURATION**powers
    )


@functools.cache
def reference(t: float) -> tuple[np.ndarray, Rotation, np.ndarray, np.ndarray, np.ndarray]:
    """Position (3), attitude, joint angles (5), rates (11) and accelerations (11)."""
    polynomial = quintic()
    blend, rate, acceleration = polynomial(t), polynomial.deriv(1)(t), polynomial.deriv(2)(t)
    roll, pitch, yaw = START_RPY + blend * (TARGET_RPY - START_RPY)
    # R = R_z(yaw) R_y(pitch) R_x(roll): each angle turns about an axis that the later ones carry
    # along.
    axis_z = np.array([0.0, 0.0, 1.0])
    axis_y = Rotation.from_euler("z", yaw).apply([0.0, 1.0, 0.0])
    axis_x = Rotation.from_euler("ZY", [yaw, pitch]).apply([1.0, 0.0, 0.0])
    d_roll, d_pitch, d_yaw = TARGET_RPY - START_RPY
    w_z, w_y, w_x = rate * d_yaw * axis_z, rate * d_pitch * axis_y, rate * d_roll * axis_x
    alpha = acceleration * (d_yaw * axis_z + d_pitch * axis_y + d_roll * axis_x)
    alpha = alpha + np.cross(w_z, w_y) + np.cross(w_z + w_y, w_x)
    d_position, d_joints = TARGET_POSITION - START_POSITION, TARGET_JOINTS - START_JOINTS
    return (
        START_POSITION + blend * d_position,
        Rotation.from_euler("xyz", [roll, pitch, yaw]),
        START_JOINTS + blend * d_joints,
        np.concatenate([rate * d_position, w_z + w_y + w_x, rate * d_joints]),
        np.concatenate([acceleration * d_position, alpha, acceleration * d_joints]),
    )


def attitude(configuration: np.ndarray) -> Rotation:
    w, x, y, z = configuration[3:7]
    return Rotation.from_quat([x, y, z, w])


def rotation_vector_rate(e: np.ndarray, w_d: np.ndarray, w: np.ndarray) -> np.ndarray:
    """de/dt of e = log(R_d R^T): R_d R^T turns with w_d - exp(e) w, which is the left Jacobian of e
    times de/dt.
    """
    cross = np.cross(np.eye(3), e)
    jacobian = np.eye(3) + cross / 2 + cross @ cross / 6 + cross @ cross @ cross / 24  # e is small
    return np.linalg.solve(jacobian, w_d - Rotation.from_rotvec(e).apply(w))


class Law(abc.ABC):
    """The injected dynamics u of a controller; subclasses hold K_s, G and the error's integral."""

    def __init__(self, scenario: Scenario) -> None:
        self.gains = types.SimpleNamespace(
            **complete_gains(scenario).controllers[scenario.controller]
        )
        self.K_D = self.diagonal(self.gains.k_d)

    @staticmethod
    def diagonal(values: Mapping[str, float] | None) -> np.ndarray:
        """A gain of the scenario, position first; unbounded where it gives none."""
        values = values or {}
        return np.array(
            [
                values.get(name, values.get(group, values.get("all", np.inf)))
                for name, group in zip(NAMES, GROUPS, strict=True)
            ]
        )

    @abc.abstractmethod
    def u(self, e: np.ndarray, de: np.ndarray, ddq_d: np.ndarray) -> np.ndarray:
        """The commanded acceleration; advances the law's own state."""


class Tdc(Law):
    """Equation (17)."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.K_P = self.diagonal(self.gains.k_p)

    def u(self, e: np.ndarray, de: np.ndarray, ddq_d: np.ndarray) -> np.ndarray:
        return ddq_d + self.K_D * de + self.K_P * e


class Asmc(Law):
    """Equations (18) and (19)."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.K_s, self.G = self.diagonal(self.gains.k_s), self.diagonal(self.gains.g_initial)
        self.a, self.b = self.diagonal(self.gains.a), self.diagonal(self.gains.b)

    def u(self, e: np.ndarray, de: np.ndarray, ddq_d: np.ndarray) -> np.ndarray:
        s = de + self.K_D * e
        u = ddq_d + self.K_D * de + self.K_s * s + self.G * np.sign(s)
        sigma = 1 if np.max(np.abs(s)) > self.gains.epsilon["all"] else -1
        for i in range(11):
            if self.G[i] > 0:
                rate = self.a[i] * (self.b[i] * max(abs(s[i]), 1e-17)) ** sigma * sigma
            else:
                rate = self.a[i] * self.b[i] * abs(s[i])
            self.G[i] = max(0, self.G[i] + PERIOD * rate)
        return u


class Aismc(Law):
    """Equations (20) and (21)."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.K_P, self.K_s = self.diagonal(self.gains.k_p), self.diagonal(self.gains.k_s_initial)
        self.K_s_max = self.diagonal(self.gains.k_s_max)
        self.alpha, self.beta = self.diagonal(self.gains.alpha), self.diagonal(self.gains.beta)
        self.integral = np.zeros(11)

    def threshold(self) -> np.ndarray:
        return self.K_s**2 / self.beta

    def switching(self, s: np.ndarray) -> np.ndarray:
        return np.zeros(11)

    def u(self, e: np.ndarray, de: np.ndarray, ddq_d: np.ndarray) -> np.ndarray:
        s = de + self.K_D * e + self.K_P * self.integral
        u = ddq_d + self.K_D * de + self.K_P * e + self.K_s * s + self.switching(s)
        rate = self.alpha * np.abs(s) * np.sign(np.abs(s) - self.threshold())
        self.K_s = np.clip(self.K_s + PERIOD * rate, 0, self.K_s_max)
        self.integral = self.integral + PERIOD * e
        return u


class Proposed(Aismc):
    """Equations (6), (9) and (10)."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.G, self.phi = self.diagonal(self.gains.g_initial), self.diagonal(self.gains.phi)

    def threshold(self) -> np.ndarray:
        return self.K_s / self.beta

    def switching(self, s: np.ndarray) -> np.ndarray:
        term = self.G * np.sign(s)
        direction = np.sign(np.max(np.abs(s)) - self.gains.epsilon["all"])
        grow_from_zero, adapt = (
            self.phi * self.gains.epsilon["all"],
            self.phi * np.abs(s) * direction,
        )
        self.G = np.maximum(0, self.G + PERIOD * np.where(self.G > 0, adapt, grow_from_zero))
        return term


LAWS: dict[str, Callable[[Scenario], Law]] = {
    "tdc": Tdc,
    "asmc": Asmc,
    "aismc": Aismc,
    "tde_aismc": Proposed,
}


def configuration_rate(configuration: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Time derivative of (position, quaternion, joints) for rates with w in world axes."""
    w, x, y, z = configuration[3:7]
    wx, wy, wz = rates[3:6]
    quaternion = [
        -wx * x - wy * y - wz * z,
        wx * w + wy * z - wz * y,
        wy * w + wz * x - wx * z,
        wz * w + wx * y - wy * x,
    ]
    return np.concatenate([rates[:3], 0.5 * np.array(quaternion), rates[6:]])


class Series(NamedTuple):
    """Time series at the control samples, each (samples, 11), position first."""

    error: np.ndarray
    force: np.ndarray  # tau, held to the next sample
    reaching_gain: np.ndarray  # K_s that the sample used; NaN where the law has none
    switching_gain: np.ndarray  # G likewise


def run_on_mujoco(scenario: Scenario, *, substeps: int = 1) -> Series:
    """The closed loop, by fourth-order Runge-Kutta steps of PERIOD / substeps."""
    plant, nominal = (
        oracle.MujocoSpacecraft(target) for target in (oracle.TRUE_TARGET, oracle.BELIEVED_TARGET)
    )
    law = LAWS[scenario.controller](scenario)

    def derivative(t: float, state: np.ndarray, tau: np.ndarray) -> np.ndarray:
        configuration, rates = state[:12], state[12:]
        acceleration = plant.acceleration(configuration, rates, tau + disturbance(t))
        return np.concatenate([configuration_rate(configuration, rates), acceleration])

    x, y, z, w = Rotation.from_euler("xyz", START_RPY).as_quat()
    state = np.concatenate([START_POSITION, [w, x, y, z], START_JOINTS, np.zeros(11)])
    tau, previous_rates = np.zeros(11), None
    samples = []
    for k in range(round(COMPARED / PERIOD) + 1):
        configuration, rates = state[:12], state[12:].copy()
        position_d, attitude_d, joints_d, rates_d, acceleration_d = reference(k * PERIOD)
        e = np.concatenate(
            [
                position_d - configuration[:3],
                (attitude_d * attitude(configuration).inv()).as_rotvec(),
                joints_d - configuration[7:],
            ]
        )
        gains = [np.array(getattr(law, name, np.full(11, np.nan))) for name in ("K_s", "G")]
        acceleration = np.zeros(11) if previous_rates is None else (rates - previous_rates) / PERIOD
        e_dot = rates_d - rates
        e_dot[3:6] = rotation_vector_rate(e[3:6], rates_d[3:6], rates[3:6])
        u = law.u(e, e_dot, acceleration_d)
        tau = tau + nominal.mass_matrix(configuration) @ (u - acceleration)
        previous_rates = rates
        samples.append([e, tau, *gains])
        h = PERIOD / substeps
        for i in range(substeps):
            t = k * PERIOD + i * h
            k1 = derivative(t, state, tau)
            k2 = derivative(t + h / 2, state + h / 2 * k1, tau)
            k3 = derivative(t + h / 2, state + h / 2 * k2, tau)
            k4 = derivative(t + h, state + h * k3, tau)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            state[3:7] /= np.linalg.norm(state[3:7])
    return Series(*np.array(samples).transpose(1, 0, 2))


def run(controller: str) -> tuple[RunRecord, Series]:
    """The package's record, and the loop above, both without measurement noise."""
    scenario = load_scenario(
        "postcapture",
        [f"controller={controller}", "sensing.velocity_noise=0", f"duration={COMPARED}"],
    )
    record = simulate(scenario)
    assert record.outcome.completed, record.outcome.message
    return record, run_on_mujoco(scenario)


def recorded(record: RunRecord, name: str) -> np.ndarray:
    """A recorded time series by coordinate (samples, 11), position first."""
    return record.dataset[name].sel(coordinate=list(NAMES)).values


def itae(errors: np.ndarray) -> float:
    """Equation (22) as a sum over the control samples."""
    times = PERIOD * np.arange(len(errors))
    return float(PERIOD * times @ np.abs(errors).sum(axis=1))


SLOW = ("asmc", "aismc", "tdc")


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in LAWS],
)
def both(request: pytest.FixtureRequest) -> tuple[RunRecord, Series]:
    return run(request.param)


@pytest.mark.slow
def test_errors_agree_at_every_sample(both: tuple[RunRecord, Series]) -> None:
    """To 1e-8, and to 1e-3 of what the coordinate ever reaches: many errors are no more than 1e-8
    themselves, and one per cent in a mass would hide in the former.
    """
    record, expected = both
    error = recorded(record, "error")
    assert error.shape == expected.error.shape == (1201, 11)
    difference = np.abs(error - expected.error).max(axis=0)
    assert_array_less(difference, 1e-8)
    assert_array_less(difference, 1e-3 * np.abs(expected.error).max(axis=0))


def test_forces_agree_at_every_sample(both: tuple[RunRecord, Series]) -> None:
    record, expected = both
    difference = np.abs(recorded(record, "generalized_force") - expected.force).max(axis=0)
    assert_array_less(difference, 2e-6 * np.abs(expected.force).max(axis=0))


def test_adaptive_gains_agree_at_every_sample(both: tuple[RunRecord, Series]) -> None:
    record, expected = both
    controller = record.scenario.controller
    assert ("reaching_gain" in record.dataset) == (controller in ("aismc", "tde_aismc"))
    assert ("switching_gain" in record.dataset) == (controller in ("asmc", "tde_aismc"))
    for name, tolerance in (("reaching_gain", 1e-5), ("switching_gain", 1e-4)):
        if name in record.dataset:
            gain = getattr(expected, name)
            assert np.ptp(gain) > 0
            difference = np.abs(recorded(record, name) - gain).max(axis=0)
            assert_array_less(difference, tolerance * gain.max(axis=0), err_msg=name)


def test_itae_agrees(both: tuple[RunRecord, Series]) -> None:
    """Also where a sign term could chatter; the sum runs over the samples that begin a period."""
    record, expected = both
    assert record.metrics["itae"] == pytest.approx(itae(expected.error[:-1]), rel=1e-3)
