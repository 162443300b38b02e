"""What one rollout costs, as ratios: against the bare plant, against the same loop on MuJoCo, by degrees of freedom.

    python benchmarks/rollout.py [--repeats 20] [--duration 20]

All compared runs take turns within one process, and what is printed are medians of the repeats, because a machine's
speed changes from minute to minute; the minima, which other work on the machine disturbs less, stand in brackets. The
scenario is ``postcapture`` with the proposed controller: 20 s, or what is asked for, at 10 ms.

(a) the bare plant: the same plant, integrator and step under a constant generalized force, AdvanceTo only;
(b) our closed loop: AdvanceTo, with everything that a run records;
(c) the same closed loop written for MuJoCo: fourth-order Runge-Kutta at 10 ms, the law in NumPy, the mass matrix of a
    second model with the nominal payload.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from ffsm_drake.runs.rollout import Rollout, RunLog
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import MassProperties, Scenario, load_scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, rotation_error_rate
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.plant import configuration, make_plant
from ffsm_drake.systems.controllers import gain_vectors
from ffsm_drake.systems.reference import make_motion

JOINTS = (5, 7, 14)
_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


class BarePlant:
    """(a)."""

    def __init__(self, scenario: Scenario) -> None:
        self.end = scenario.num_control_periods * scenario.sample_time
        plant = make_plant(scenario.model)
        self.simulator = Simulator(plant)
        ApplySimulatorConfig(scenario.simulator_config, self.simulator)
        context = self.simulator.get_mutable_context()
        set_payload(plant, context, body=scenario.payload.body, properties=scenario.payload.truth)
        plant.SetPositions(context, configuration(plant, scenario.initial_posture, key="initial_posture"))
        force = np.full(plant.num_velocities(), 0.01)
        plant.get_applied_generalized_force_input_port().FixValue(context, force)
        self.start = context.Clone()

    def advance_time(self) -> float:
        """Wall time of one run, s."""
        self.simulator.get_mutable_context().SetTimeStateAndParametersFrom(self.start)
        self.simulator.Initialize()
        start = time.perf_counter()
        self.simulator.AdvanceTo(self.end)
        return time.perf_counter() - start


class Arm(NamedTuple):
    """A base and a serial arm, links along z, with the payload ahead of the last: what the models below describe."""

    masses: Sequence[float]  # kg
    lengths: Sequence[float]  # m
    axes: Sequence[str]
    drive: float = 0.0  # kg m^2, moment of inertia of a joint's drive, which its link carries, about any axis

    @classmethod
    def of(cls, joints: int) -> "Arm":
        """The shipped arm for five joints; for any other number one of its mass and length, in equal links.

        Those get drives: without, so short and slender links hardly have inertia about the axes between them, the
        disturbance throws them about, and what is compared is how it is sampled.
        """
        if joints == 5:
            return cls((3.0, 10.0, 10.0, 1.5, 1.5), (0.18, 0.62, 0.62, 0.09, 0.09), ("z", "y", "y", "y", "x"))
        axes = [("z", "y", "y", "x")[i % 4] for i in range(joints)]
        return cls((26.0 / joints,) * joints, (1.6 / joints,) * joints, axes, drive=0.5)

    def parts(self) -> Iterator[tuple[float, float, float, str, float, float]]:
        """Of each link: place along the link before, mass, length, axis, moment of inertia across and along."""
        for place, mass, length, axis in zip((1.0, *self.lengths), self.masses, self.lengths, self.axes, strict=False):
            across, along = mass * length**2 / 12, mass * 0.05**2 / 2
            yield place, mass, length, axis, across + self.drive, along + self.drive

    def urdf(self) -> str:
        def body(name: str, mass: float, z: float, across: float, along: float) -> str:
            moments = f'ixx="{across}" iyy="{across}" izz="{along}" ixy="0" ixz="0" iyz="0"'
            origin, inertia = f'<origin xyz="0 0 {z}"/>', f"<inertia {moments}/>"
            return f'<link name="{name}"><inertial>{origin}<mass value="{mass}"/>{inertia}</inertial></link>'

        def joint(name: str, kind: str, parent: str, child: str, z: float, axis: str) -> str:
            ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 {z}"/>'
            return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="{_AXES[axis]}"/></joint>'

        text, before = body("base", 400.0, 0.0, 266.0, 266.0), "base"
        for i, (place, mass, length, axis, across, along) in enumerate(self.parts(), start=1):
            text += body(f"link_{i}", mass, length / 2, across, along)
            text += joint(f"joint_{i}", "revolute", before, f"link_{i}", place, axis)
            before = f"link_{i}"
        text += body("payload", 100.0, 0.0, 16.7, 16.7)
        text += joint("grasp", "fixed", before, "payload", self.lengths[-1] + 0.5, "z")
        return f'<robot name="arm">{text}</robot>'

    def mjcf(self, payload: MassProperties) -> str:
        def inertial(mass: float, z: float, moments: Sequence[float]) -> str:
            return f'<inertial pos="0 0 {z}" mass="{mass}" diaginertia="{" ".join(map(str, moments))}"/>'

        text = inertial(payload.mass, 0.0, payload.inertia)
        text = f'<body name="payload" pos="0 0 {self.lengths[-1] + 0.5}">{text}</body>'
        for i, (place, mass, length, axis, across, along) in reversed(list(enumerate(self.parts(), start=1))):
            joint = f'<joint name="joint_{i}" type="hinge" axis="{_AXES[axis]}"/>'
            text = joint + inertial(mass, length / 2, (across, across, along)) + text
            text = f'<body name="link_{i}" pos="0 0 {place}">{text}</body>'
        text = f'<body name="base"><freejoint/>{inertial(400.0, 0.0, (266.0,) * 3)}{text}</body>'
        option = '<option gravity="0 0 0" integrator="RK4" timestep="0.01"/>'
        return f"<mujoco>{option}<worldbody>{text}</worldbody></mujoco>"


def arm_scenario(joints: int, folder: Path, *overrides: str) -> Scenario:
    """``postcapture`` with a generated arm; joints beyond the fifth stay at zero."""
    model, directives = folder / f"arm_{joints}.urdf", folder / f"arm_{joints}.dmd.yaml"
    model.write_text(Arm.of(joints).urdf())
    directives.write_text(f"directives:\n- add_model: {{name: arm, file: 'file://{model}'}}\n")
    arm = (f"model.directives={directives}", "model.end_effector=arm::payload", "payload.body=arm::payload")
    return load_scenario("postcapture", (*arm, *overrides))


class MujocoLoop:
    """(c). MuJoCo's angular velocity is in body axes and its position comes first; the law works as ours does, in world
    axes and Drake's order, so that gains mean the same."""

    def __init__(self, scenario: Scenario, coordinates: Coordinates) -> None:
        self.scenario = scenario
        arm, payload = Arm.of(len(coordinates.joints)), scenario.payload
        self.model, self.nominal = (
            mujoco.MjModel.from_xml_string(arm.mjcf(properties)) for properties in (payload.truth, payload.nominal)
        )
        self.data, self.nominal_data = mujoco.MjData(self.model), mujoco.MjData(self.nominal)
        self.motion = make_motion(scenario, coordinates)
        self.gains = gain_vectors(scenario, coordinates)
        harmonics = scenario.disturbance.harmonics
        self.harmonics = [
            coordinates.vector({n: getattr(h, field) for n, h in harmonics.items()}, key=field, default=0.0)
            for field in ("amplitude", "frequency", "phase", "bias")
        ]

    def run(self, noise: np.ndarray) -> np.ndarray:
        """The error (n, nv) at every sample; ``noise`` (n, nv) is what the sensors add to the velocities."""
        model, data, nominal, nominal_data = self.model, self.data, self.nominal, self.nominal_data
        period, num_samples, nv = self.scenario.sample_time, len(noise), noise.shape[1]
        k_d, k_p, alpha, beta, phi = (self.gains[name] for name in ("k_d", "k_p", "alpha", "beta", "phi"))
        k_s, g, k_s_max = self.gains["k_s_initial"], self.gains["g_initial"], self.gains["k_s_max"]
        epsilon = self.gains["epsilon"]
        # Plan and disturbance are known beforehand; MuJoCo holds forces over a step, so the disturbance is that of the
        # step's middle.
        times = period * np.arange(num_samples)
        plan, plan_acceleration = np.split(self.motion.rows(times), [2 * nv + 1], axis=1)
        amplitude, frequency, phase, bias = self.harmonics
        disturbances = amplitude * np.sin(frequency * (times[:, None] + 0.5 * period) + phase) + bias
        mujoco.mj_resetData(model, data)
        data.qpos[:3], data.qpos[3:7], data.qpos[7:] = plan[0, 4:7], plan[0, :4], plan[0, 7 : nv + 1]
        errors, forces, sliding, reaching, switching = (np.empty((num_samples, nv)) for _ in range(5))
        positions, velocities = np.empty((num_samples, nv + 1)), np.empty((num_samples, nv))
        force, integral, previous = np.zeros(nv), np.zeros(nv), None
        turn, inverse, difference, rotation = np.empty(9), np.empty(4), np.empty(4), np.empty(3)
        change, product, v, e = np.empty(nv), np.empty(nv), np.empty(nv), np.empty(nv)
        for k in range(num_samples):
            qpos, qvel = data.qpos, data.qvel
            mujoco.mju_quat2Mat(turn, qpos[3:7])
            to_world = turn.reshape(3, 3)
            v[:3], v[3:6], v[6:] = to_world.dot(qvel[3:6]), qvel[:3], qvel[6:]
            # The rotation vector, in the world, from the attitude to the planned one.
            mujoco.mju_negQuat(inverse, qpos[3:7])
            mujoco.mju_mulQuat(difference, plan[k, :4], inverse)
            mujoco.mju_quat2Vel(rotation, difference, 1.0)
            e[:3], e[3:6], e[6:] = rotation, plan[k, 4:7] - qpos[:3], plan[k, 7 : nv + 1] - qpos[7:]
            measured = v + noise[k]
            e_dot = plan[k, nv + 1 :] - measured
            e_dot[:3] = rotation_error_rate(tuple(rotation.tolist()), plan[k, nv + 1 : nv + 4], measured[:3])
            s = e_dot + k_d * e + k_p * integral
            u = plan_acceleration[k] + k_d * e_dot + k_p * e + k_s * s + g * np.sign(s)
            positions[k], velocities[k], errors[k] = qpos, v, e
            sliding[k], reaching[k], switching[k] = s, k_s, g
            magnitude = np.abs(s)
            rate = np.where(g > 0.0, np.sign(magnitude.max() - epsilon) * phi * magnitude, epsilon * phi)
            k_s = np.clip(k_s + period * alpha * magnitude * np.sign(magnitude - k_s / beta), 0.0, k_s_max)
            g = np.maximum(g + period * rate, 0.0)
            integral = integral + period * e
            if previous is not None:
                u = u - (measured - previous) / period
            previous = measured
            # Hhat (u - a), with the rotation turned into body axes and back.
            nominal_data.qpos[:] = qpos
            mujoco.mj_kinematics(nominal, nominal_data)
            mujoco.mj_comPos(nominal, nominal_data)
            mujoco.mj_makeM(nominal, nominal_data)
            change[:3], change[3:6], change[6:] = u[3:6], u[:3].dot(to_world), u[6:]
            mujoco.mj_mulM(nominal, nominal_data, product, change)
            force[:3] += to_world.dot(product[3:6])
            force[3:6] += product[:3]
            force[6:] += product[6:]
            forces[k] = force
            if k < num_samples - 1:
                total = force + disturbances[k]
                applied = data.qfrc_applied
                applied[:3], applied[3:6], applied[6:] = total[3:6], total[:3].dot(to_world), total[6:]
                mujoco.mj_step(model, data)
        return errors


def sensor_noise(log: RunLog) -> np.ndarray:
    """What the sensors added to the velocities (n, nv)."""
    difference = log.series["measurement"] - log.series["state"]
    return difference[:, len(log.coordinates.position_names) :]


def timed(work: Callable[[], object]) -> float:
    """Wall time, s."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


class Timing(NamedTuple):
    """Seconds."""

    median: float
    minimum: float

    def over(self, other: "Timing") -> str:
        """The ratio to another, of medians and in brackets of minima."""
        return f"{self.median / other.median:.2f} ({self.minimum / other.minimum:.2f})"

    def __str__(self) -> str:
        return f"{1e3 * self.median:7.1f} ms ({1e3 * self.minimum:7.1f})"


def interleaved(contestants: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, Timing]:
    """Each contestant's times, all taking turns, after one round to warm up."""
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(repeats + 1):
        for name, contestant in contestants.items():
            seconds = contestant()
            if turn > 0:
                times[name].append(seconds)
    return {name: Timing(statistics.median(values), min(values)) for name, values in times.items()}


class Contest(NamedTuple):
    """(a), (b) and (c) of one scenario."""

    rollout: Rollout
    contestants: dict[str, Callable[[], float]]  # seconds
    difference: np.ndarray  # (n, nv) between the errors of (b) and (c)


def contest(scenario: Scenario) -> Contest:
    rollout = Rollout(scenario)
    log = rollout.run()
    if not log.outcome.completed:
        raise SystemExit(log.outcome.message)
    bare, loop, noise = BarePlant(scenario), MujocoLoop(scenario, log.coordinates), sensor_noise(log)
    contestants = {
        "a": bare.advance_time,
        "b": lambda: rollout.run().wall_time["advance_to"],
        "c": lambda: timed(lambda: loop.run(noise)),
    }
    return Contest(rollout, contestants, log.error - loop.run(noise))


def start_times(repeats: int, duration: str) -> dict[str, Timing]:
    """Wall time of fresh interpreters, less that of an empty one."""
    scenario = f"f.load_scenario('postcapture', ['{duration}'])"
    codes = {
        "empty": "pass",
        "import pydrake.multibody.plant": "import pydrake.multibody.plant",
        "import ffsm_drake": "import ffsm_drake",  # which loads the rest when it is used
        "import ffsm_drake.runs.rollout": "import ffsm_drake.runs.rollout",
        "first metrics, simulate": f"import ffsm_drake as f; f.simulate({scenario}).metrics",
        "first metrics, Rollout": "import ffsm_drake as f; from ffsm_drake.runs.rollout import Rollout; "
        f"Rollout({scenario}).run().metrics",
    }
    commands = {name: [sys.executable, "-c", code] for name, code in codes.items()}
    contestants = {
        name: lambda command=command: timed(lambda: subprocess.run(command, check=True, capture_output=True))
        for name, command in commands.items()
    }
    times = interleaved(contestants, repeats)
    empty = times.pop("empty")
    return {name: Timing(t.median - empty.median, t.minimum - empty.minimum) for name, t in times.items()}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=20, help="repeats of each measurement (default: 20)")
    parser.add_argument("--duration", type=float, default=20.0, help="simulated time of a run, s (default: 20)")
    arguments = parser.parse_args(argv)
    repeats, duration = arguments.repeats, f"duration={arguments.duration:g}"
    fewer = min(repeats, max(5, repeats // 4))

    scenario = load_scenario("postcapture", [duration])
    rollout, contestants, difference = contest(scenario)
    times = interleaved(
        contestants
        | {
            "build": lambda: timed(lambda: Rollout(scenario)),
            "run": lambda: timed(lambda: rollout.run().metrics),
            "simulate": lambda: timed(lambda: simulate(scenario, check_stability=False)),
        },
        repeats,
    )
    a, b, c = (times[name] for name in "abc")
    print(f"postcapture, tde_aismc, {arguments.duration:g} s: medians of {repeats} interleaved repeats (minima)")
    print(f"  (a) bare plant         {a}")
    print(f"  (b) closed loop        {b}   b/a {b.over(a)}")
    print(f"  (c) same on MuJoCo     {c}   b/c {b.over(c)}")
    samples = scenario.num_control_periods
    print(f"  (b) - (a) per control sample: {(b.median - a.median) / samples * 1e6:.0f} us", end=" ")
    print(f"({(b.minimum - a.minimum) / samples * 1e6:.0f})")
    print(f"  final error, largest difference (b) - (c): {np.abs(difference[-1]).max():.1e}")
    print(f"  error of the whole run, likewise:          {np.abs(difference).max():.1e}")
    print(f"  Rollout(scenario)      {times['build']}   {times['build'].over(b)} of (b)")
    print(f"  run() and its metrics  {times['run']}   {times['run'].over(b)} of (b)")
    print(f"  simulate()             {times['simulate']}   {times['simulate'].over(b)} of (b)")

    print(f"cost against joints, generated arms, medians of {fewer} (minima)")
    with tempfile.TemporaryDirectory() as folder:
        arms = {joints: contest(arm_scenario(joints, Path(folder), duration)) for joints in JOINTS}
    # All arms take turns, too: a machine whose speed changes would show in the exponents.
    times = interleaved(
        {f"{name}{joints}": work for joints, arm in arms.items() for name, work in arm.contestants.items()}, fewer
    )
    for joints, arm in arms.items():
        a, b, c = (times[f"{name}{joints}"] for name in "abc")
        print(f"  {joints:2d}: (a) {a}  (b) {b}  (c) {c}")
        final = np.abs(arm.difference[-1]).max()
        print(f"      b/a {b.over(a)}  b/c {b.over(c)}  final error, (b) - (c): {final:.1e}")
    columns = {name: [times[f"{name}{joints}"].minimum for joints in JOINTS] for name in "abc"}
    degrees = np.log([joints + 6 for joints in JOINTS])
    exponents = {name: np.polyfit(degrees, np.log(column), 1)[0] for name, column in columns.items()}
    print("  minima ~ (degrees of freedom)^p: " + ", ".join(f"({name}) p = {p:.2f}" for name, p in exponents.items()))

    start = start_times(fewer, duration)
    print(f"start-up, medians of {fewer} fresh interpreters (minima), less an empty one's")
    for name, timing in start.items():
        ratio = timing.over(start["import pydrake.multibody.plant"])
        print(f"  {name:32s} {timing}   {ratio} of pydrake.multibody.plant")


if __name__ == "__main__":
    main()
