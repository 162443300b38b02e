"""Robots of two published model-predictive controllers, with their laws and those of this package.

    python benchmarks/peers.py
    python benchmarks/peers.py --stored Casadi_SQP_data.mat

The figures of ``docs/validation/control.md``. With --stored, a result of the first repository: its
torques on this package's plant, and when its joints come within 2 % of the step.
"""

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake import ControlLaw, PlantModel, gain, load_scenario, make_true_plant, simulate
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import AlongMotion
from ffsm_drake.systems.setup import BlockSetup

HERE = Path(__file__).parent
PLANAR, WHEELS = HERE / "air_bearing" / "scenario.yaml", HERE / "small_wheels" / "scenario.yaml"
TORQUE = np.array([5.0, 2.5, 2.5])  # N m, of the planar robot's joints
LIMIT = "actuation.limit={joint_1: 5.0, joint_2: 2.5, joint_3: 2.5}"
TOOL = np.array([-0.1384, -0.4628, -0.7569])  # m, in the base's axes
# 200, 150, 150 on the planar robot's joints and 20 on their rates, next to none on accelerations
PUBLISHED_WEIGHTS = (
    "{error_size: {all: 0.0816, joint_1: 0.0707}, rate_size: 0.2236, acceleration_size: 20.0, "
    "prediction_step: 0.02}"
)
# the gains of the defaults; limits weigh more against errors
WEIGHTS = "{error_size: 0.1, rate_size: 0.2, acceleration_size: 2.0}"
NAMES = ("joint_1", "joint_2", "joint_3")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pd(ControlLaw):
    """tau = K_p e + K_d e', with the published gains."""

    k_p: np.ndarray = gain(1.0, "N m/rad", "on the error")
    k_d: np.ndarray = gain(0.5, "N m s/rad", "on its rate")

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        return self.k_p * sample.e + self.k_d * sample.e_dot, state


@dataclasses.dataclass(frozen=True, kw_only=True)
class Smc(ControlLaw):
    """tau = H (lambda e' + K_s sat(s / phi)) + C with s = e' + lambda e, in the published limits;
    H and C are those of the joints with the base free.
    """

    model: PlantModel
    surface: float = gain(5.0, "1/s", "lambda", scalar=True)
    k_s: float = gain(2.0, "rad/s^2", "switching gain", scalar=True)
    layer: float = gain(0.05, "rad/s", "boundary layer phi", scalar=True)

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        s = sample.e_dot + self.surface * sample.e
        u = self.surface * sample.e_dot + self.k_s * np.clip(s / self.layer, -1.0, 1.0)
        force = self.model.calc_mass_matrix(sample.q) @ u
        force = force + self.model.calc_bias(sample.q, sample.v)
        force[-3:] = np.clip(force[-3:], -TORQUE, TORQUE)
        return force, state


class Held(PlannedMotion):
    """A posture that is asked for at once."""

    def __init__(self, q: np.ndarray, **how: Any) -> None:
        self._row = q
        super().__init__(end=1.0, **how)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rest = np.zeros(2 * len(self.coordinates.names))
        return np.tile(np.concatenate([self._row, rest]), (len(times), 1))


def flown(scenario: Scenario, *, law: Any = None, at_once: bool = True) -> RunRecord:
    """A run, along the scenario's plan or with its goal asked for at once.

    Args:
      law: a class in place of the scenario's law.
    """

    def reference(setup: BlockSetup) -> Any:
        goal = scenario.target_posture
        q = [1.0, 0.0, 0.0, 0.0, *goal.base_position, *(goal.joints[name] for name in NAMES)]
        held = Held(np.array(q), coordinates=setup.coordinates, sample_time=scenario.sample_time)
        return AlongMotion(motion=held)

    blocks: dict[str, Any] = {"reference": reference} if at_once else {}
    if law is not None:
        blocks["controller"] = law.from_setup
    return simulate(scenario, blocks=blocks, check_stability=False)


def planar(degrees: float, *overrides: str, law: Any = None, at_once: bool = True) -> RunRecord:
    """The planar robot's first joint to an angle."""
    goal = f"target_posture.joints.joint_1={float(np.deg2rad(degrees))!r}"
    return flown(load_scenario(PLANAR, [goal, *overrides]), law=law, at_once=at_once)


def turn_of_base(record: RunRecord) -> np.ndarray:
    """Angles (n) by which the base has turned about z, rad."""
    q = record.dataset["position"].values
    angles: np.ndarray = 2.0 * np.arctan2(q[:, 3], q[:, 0])
    return angles


def drift(record: RunRecord) -> tuple[float, float]:
    """Largest change of linear (N s) and angular momentum (N m s, about the world's origin)."""
    momenta = (record.dataset[f"{kind}_momentum"].values for kind in ("linear", "angular"))
    linear, angular = (float(np.abs(rows - rows[0]).max()) for rows in momenta)
    return linear, angular


def arrival(time_of: np.ndarray, joints: np.ndarray, goal: np.ndarray) -> float:
    """Time (s) from which all joints (n, 3) stay within 2 % of the largest step of their goal."""
    off = np.abs(joints - goal).max(axis=1)
    outside = np.flatnonzero(off > 0.02 * off[0])
    return float(time_of[min(outside[-1] + 1, len(time_of) - 1)])


def arrived(record: RunRecord) -> float:
    """``arrival`` in a run."""
    goal = np.array([record.scenario.target_posture.joints[name] for name in NAMES])
    joints = record.dataset["position"].values[:, -3:]
    return arrival(record.dataset["time"].values, joints, goal)


def tool_in_base(record: RunRecord) -> np.ndarray:
    """Place (3) of the tool at the end, in the base's axes from its origin, m."""
    model = make_true_plant(record.scenario)
    q = record.dataset["position"].values[-1].copy()
    q[:7] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    return model.calc_frame_pose(q, "servicer::tool")[4:]


def on_the_wheels(record: RunRecord) -> dict[str, float]:
    """What a run of the robot with wheels uses of its limits, and where its tool ends."""
    dataset = record.dataset
    q = dataset["position"].values
    return {
        "tool off, m": float(np.linalg.norm(tool_in_base(record) - TOOL)),
        "arrived, s": arrived(record),
        "wheels, N m": float(np.abs(dataset["wheel_torque"].values).max()),
        "joints, N m": float(np.abs(dataset["applied_force"].values[:, -3:]).max()),
        "rate, rad/s": float(np.abs(dataset["velocity"].values[:, -3:]).max()),
        "base, deg": float(
            np.rad2deg(2.0 * np.arctan2(np.linalg.norm(q[:, 1:4], axis=1), np.abs(q[:, 0]))).max()
        ),
    }


def moved(torque: Callable[[int, np.ndarray], np.ndarray], count: int) -> np.ndarray:
    """[turn, x, y, joints, and their rates] (n + 1, 12) of the planar robot by the fourth-order
    Runge-Kutta method with 10 ms, as in the repository; torque (3) of the step and the state.
    """
    x, h = np.zeros(12), 0.01
    x[1:3] = load_scenario(PLANAR).initial_posture.base_position[:2]
    rows = [x]
    for k in range(count):
        a = _rate(x, torque(k, x))
        b = _rate(y := x + 0.5 * h * a, torque(k, y))
        c = _rate(y := x + 0.5 * h * b, torque(k, y))
        d = _rate(y := x + h * c, torque(k, y))
        x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        rows.append(x)
    return np.array(rows)


_MOVING = [2, 3, 4, 6, 7, 8]  # of v


@functools.cache
def _plant() -> PlantModel:
    return make_true_plant(load_scenario(PLANAR))


def _posture(x: np.ndarray) -> np.ndarray:
    return np.array([np.cos(x[0] / 2), 0.0, 0.0, np.sin(x[0] / 2), *x[1:3], 0.0, *x[3:6]])


def _rate(x: np.ndarray, torque: np.ndarray) -> np.ndarray:
    q, v = _posture(x), np.zeros(9)
    v[_MOVING] = x[6:]
    force = np.concatenate([np.zeros(3), torque]) - _plant().calc_bias(q, v)[_MOVING]
    mass_matrix = _plant().calc_mass_matrix(q)[np.ix_(_MOVING, _MOVING)]
    return np.concatenate([x[6:], np.linalg.solve(mass_matrix, force)])


def momenta(rows: np.ndarray) -> np.ndarray:
    """[linear x, y; angular about the world's origin] (n, 3) of states from ``moved``."""
    found = []
    for x in rows:
        turning, *linear = (_plant().calc_mass_matrix(_posture(x))[2:5, _MOVING] @ x[6:]).tolist()
        found.append([*linear, turning + x[1] * linear[1] - x[2] * linear[0]])
    return np.array(found)


def stored(path: str) -> None:
    """Print the stored result of the first repository beside its torques on this plant."""
    from scipy.io import loadmat

    data = loadmat(path)
    theirs = data["X"][[5, 0, 1, 6, 7, 8]].T
    torques = data["Tau"].T
    off = np.abs(moved(lambda k, x: torques[k], len(torques))[:, :6] - theirs).max(axis=0)
    goal = np.array([float(data["param"]["xref"][0, 0][6, 0]), 0.0, 0.0])
    within = arrival(0.01 * np.arange(len(theirs)), theirs[:, 3:], goal)
    print(f"stored torques on this plant: {off[:3].max():.1e} rad or m of the base, ", end="")
    print(f"{off[3:].max():.1e} rad of the joints off over {0.01 * (len(theirs) - 1):g} s")
    print(f"stored: base at the end {theirs[-1, :3]}; within 2 % after {within:.2f} s", end="")
    if "t_mpc" in data:
        print(f"; {np.median(data['t_mpc']):.2f} s a sample (median, stored)", end="")
    print()


def main() -> None:
    """Print the figures of both robots."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stored", metavar="FILE", help="a .mat file of the first repository")
    path = parser.parse_args().stored
    if path:
        stored(path)
        return
    goal = np.array([np.deg2rad(-30.0), 0.0, 0.0])
    found = momenta(moved(lambda k, x: goal - x[3:6] - 0.5 * x[9:], 2000))
    linear, angular = np.linalg.norm(found[:, :2], axis=1).max(), np.abs(found[:, 2]).max()
    print(f"their PD, fourth order: momentum to {linear:.2e} N s, {angular:.2e} N m s")
    for degrees, name, law, overrides in (
        (-30.0, "their PD", Pd, ()),
        (-30.0, "their PD, fifth order", Pd, ("simulator_config.integration_scheme=runge_kutta5",)),
        (-30.0, "their SMC", Smc, ()),
        (50.0, "mpc", None, ("controller=mpc", f"controllers.mpc={PUBLISHED_WEIGHTS}", LIMIT)),
        (50.0, "nmpc", None, ("controller=nmpc", f"controllers.nmpc={PUBLISHED_WEIGHTS}", LIMIT)),
        (50.0, "tde_aismc, plan", None, ("controller=tde_aismc", LIMIT, "reference.duration=auto")),
    ):
        begin = time.process_time()
        record = planar(degrees, *overrides, law=law, at_once="plan" not in name)
        x, y = record.dataset["position"].values[-1, 4:6]
        linear, angular = drift(record)
        print(
            f"{degrees:g} deg, {name}: base at the end {x:.5f} {y:.5f} m, "
            f"{turn_of_base(record)[-1]:.5f} rad; within 2 % after {arrived(record):.2f} s; torque "
            f"{np.abs(record.dataset['applied_force'].values[:, -3:]).max(axis=0).round(3)} N m; "
            f"momentum to {linear:.1e} N s, {angular:.1e} N m s; "
            f"processor time {time.process_time() - begin:.1f} s",
            flush=True,
        )
    for name, given in (
        ("tde_aismc, plan", ["controller=tde_aismc"]),
        ("mpc", ["controller=mpc", f"controllers.mpc={WEIGHTS}", "reference.duration=20"]),
        ("nmpc", ["controller=nmpc", f"controllers.nmpc={WEIGHTS}", "reference.duration=20"]),
    ):
        begin = time.process_time()
        record = flown(load_scenario(WHEELS, given), at_once="plan" not in name)
        used = ", ".join(f"{key} {value:.4g}" for key, value in on_the_wheels(record).items())
        print(f"wheels, {name}: {used}; ", end="")
        print(f"processor time {time.process_time() - begin:.1f} s", flush=True)


if __name__ == "__main__":
    main()
