"""The generalized Jacobian and resolved motion against space-robot-dq v0.3.0.

HJahanshahi/space-robot-dq (MIT), ``examples/generate_paper_figures.py``: its arm of seven joints on
a base of 100 kg, its deterministic experiments and their printed figures. The base moves by
momentum, with their first-order steps of 10 ms; Jacobians and inertia are those of this package.
"""

import functools
import itertools
import tempfile
from pathlib import Path

import numpy as np
import pytest
from outside_urdfs import joint, link, robot
from scipy.spatial.transform import Rotation

from ffsm_drake import free_floating, load_scenario, make_true_plant

AXES = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
HEIGHTS = (0.0, 0.31, 0.31, 0.71, 0.71, 1.1, 1.1, 1.178)  # m; joints, then the tool
STEP = 0.01  # s


def cylinder(height, next_height):
    """Mass, moments and centre of a link: 15 kg/m, 4 cm of radius, 1 kg and 5 cm at least."""
    length = next_height - height
    mass, size = (15.0 * length, length) if length else (1.0, 0.05)
    across = mass * (3.0 * 0.04**2 + size**2) / 12.0
    return mass, (across, across, 0.5 * mass * 0.04**2), 0.5 * length


@functools.cache
def model(base_mass=100.0):
    inertia = tuple(base_mass * np.array([0.1, 0.1, 0.08]))
    parts, parent = [link("base", mass=base_mass, inertia=inertia)], "base"
    for i, (height, after) in enumerate(itertools.pairwise(HEIGHTS)):
        mass, inertia, center = cylinder(height, after)
        below = HEIGHTS[i - 1] if i else 0.0
        parts += [
            joint(f"j{i}", parent, f"l{i}", axis=AXES[i], xyz=f"0 0 {height - below}"),
            link(f"l{i}", mass=mass, inertia=inertia, com=(0.0, 0.0, center)),
        ]
        parent = f"l{i}"
    parts += [joint("tip", parent, "tool", kind="fixed", xyz="0 0 0.078"), link("tool")]
    mass, inertia, center = cylinder(*HEIGHTS[-2:])
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "dq.urdf").write_text(robot(*parts))
        (Path(folder) / "dq.dmd.yaml").write_text(
            f"directives:\n- add_model:\n    name: dq\n    file: file://{folder}/dq.urdf\n"
        )
        payload = {"mass": mass, "center_of_mass": [0.0, 0.0, center], "inertia": list(inertia)}
        postures = {f"j{i}": 0.0 for i in range(7)}
        scenario = load_scenario(
            "postcapture",
            [
                f"model.directives={folder}/dq.dmd.yaml", "model.end_effector=dq::tool",
                f"payload={{body: 'dq::l6', truth: {payload}, nominal: {payload}}}",
                f"initial_posture.joints={postures}", f"target_posture.joints={postures}",
                "disturbance.amplitude_scale=0",
            ],
        )  # fmt: skip
        return make_true_plant(scenario)


def at(joints, R_WB=np.eye(3), p_WB=np.zeros(3), base_mass=100.0):  # noqa: B008
    """q, the state's inertia, J_g (6, 7) and J_m (6, 7)."""
    x, y, z, w = Rotation.from_matrix(R_WB).as_quat()
    q, own = np.concatenate([[w, x, y, z], p_WB, joints]), model(base_mass)
    spacecraft = free_floating(own, q)
    jacobian = own.calc_jacobian(q, "dq::tool")
    return q, spacecraft, spacecraft.generalized_jacobian(jacobian), jacobian[:, 6:]


class Flight:
    """Their plant: joint rates move the base by momentum, in first-order steps."""

    def __init__(self, joints):
        self.joints, self.R_WB, self.p_WB = np.array(joints), np.eye(3), np.zeros(3)

    def read(self):
        q, self._spacecraft, generalized, fixed = at(self.joints, self.R_WB, self.p_WB)
        pose = model().calc_frame_pose(q, "dq::tool")
        R_WT = Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix()
        return {"generalized": generalized, "fixed": fixed}, R_WT, pose[4:]

    def advance(self, rates):
        v = self._spacecraft.velocity(rates)
        self.p_WB = self.p_WB + STEP * v[3:6]
        self.R_WB = Rotation.from_rotvec(STEP * v[:3]).as_matrix() @ self.R_WB
        self.joints = self.joints + STEP * rates
        return v

    @property
    def drift(self):
        """Rotation of the base from the start, deg."""
        return np.degrees(Rotation.from_matrix(self.R_WB).magnitude())


def damped(jacobian, wanted):
    square = jacobian @ jacobian.T + 1e-6 * np.eye(len(jacobian))
    return jacobian.T @ np.linalg.solve(square, wanted)


SINE = np.array([0.3, 0.5, -0.3, 1.0, 0.2, 0.6, 0.1])
START = np.array([0.3, 0.4, -0.2, 0.8, 0.1, 0.5, 0.0])
PUBLISHED = np.array([
    [.120106, -.202212, .650728, -.40567, .088034, -.231498, -.412846],
    [.080661, .735431, .202938, .811996, -.211669, .940992, -.322046],
    [.858021, .027242, -.325455, -.239606, -.885507, -.244053, -.850276],
    [-.167371, .160135, .128057, -.009759, .074012, -.0322, .010681],
    [.407547, .052365, -.329982, -.105481, -.330043, -.024803, -.071351],
    [-.014884, -.458086, .049168, -.378437, .088792, -.065469, .021886],
])  # fmt: skip


@pytest.mark.smoke
def test_the_generalized_jacobian():
    """All six digits of theirs, and the dynamic manipulability of both Jacobians."""
    q, _, generalized, fixed = at(SINE)
    np.testing.assert_allclose(generalized, PUBLISHED, atol=6e-7)
    tool = model().calc_frame_pose(q, "dq::tool")[4:]
    np.testing.assert_allclose(tool, (0.584653, 0.269461, 0.650439), atol=6e-7)
    measures = [np.sqrt(np.linalg.det(J @ J.T)) for J in (generalized, fixed)]
    np.testing.assert_allclose(measures, (0.0161556, 0.0471169), atol=6e-8)


def test_mass_ratios():
    """Ratio of masses -> ratio of manipulabilities, largest difference of the Jacobians."""
    arm = sum(cylinder(*pair)[0] for pair in itertools.pairwise(HEIGHTS))
    for ratio, share, largest in (
        (0.5, 0.036, 0.4867), (5, 0.351, 0.2316), (10, 0.539, 0.1505), (100, 0.928, 0.0207),
    ):  # fmt: skip
        _, _, generalized, fixed = at(SINE, base_mass=ratio * arm)
        measures = [np.sqrt(np.linalg.det(J @ J.T)) for J in (generalized, fixed)]
        assert measures[0] / measures[1] == pytest.approx(share, abs=5.1e-4)
        assert np.abs(generalized - fixed).max() == pytest.approx(largest, abs=5.1e-5)


def test_the_sinusoid_turns_the_base():
    amplitude = np.array([0.4, 0.3, 0.5, 0.4, 0.3, 0.2, 0.3])
    frequency = np.array([1.0, 1.5, 0.8, 1.2, 2.0, 1.0, 1.5]) * np.pi / 2.0
    flight, pushes = Flight(SINE), []
    for k in range(201):
        flight.joints = SINE + amplitude * np.sin(frequency * k * STEP)
        rates = amplitude * frequency * np.cos(frequency * k * STEP)
        jacobians, _, _ = flight.read()
        if k == 0:
            speeds = [np.linalg.norm((J @ rates)[3:]) for J in jacobians.values()]
            np.testing.assert_allclose(speeds, (0.643, 0.843), atol=5.1e-4)
        drift = flight.drift
        pushes.append(np.linalg.norm(flight.advance(rates)[3:6]))
    assert drift == pytest.approx(6.94, abs=5.1e-3)
    assert max(pushes) == pytest.approx(0.030, abs=5.1e-4)


def followed(which):
    """Root mean square and last error (mm) along the line, and the base's drift (deg)."""
    flight, errors = Flight(START), []
    first = flight.read()[2]
    displacement, duration = np.array([-0.20, 0.10, -0.15]), 4.0
    for k in range(401):
        s = min(k * STEP / duration, 1.0)
        share = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
        rate = (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4) / duration
        jacobians, _, place = flight.read()
        error = first + share * displacement - place
        errors.append(np.linalg.norm(error))
        drift = flight.drift
        J = jacobians[which][3:]
        rates = damped(J, rate * displacement + error)
        away = 0.5 * (START - flight.joints)
        rates = rates + away - damped(J, J @ away)
        flight.advance(np.clip(rates, -1.5, 1.5))
    return 1e3 * np.sqrt(np.mean(np.square(errors))), 1e3 * errors[-1], drift


@pytest.mark.slow
def test_a_line_is_followed_with_the_generalized_jacobian():
    assert followed("fixed")[0] == pytest.approx(26.372, abs=5.1e-4)
    rms, last, drift = followed("generalized")
    assert rms == pytest.approx(0.251, abs=5.1e-4)
    assert last == pytest.approx(0.242, abs=5.1e-4)
    assert drift == pytest.approx(6.88, abs=5.1e-3)


def held(which):
    """Root mean squares of position (mm) and attitude (deg), and the base's drift (deg)."""
    flight, errors = Flight(START), []
    _, R_first, first = flight.read()
    axis = np.array([0.3, 1.0, 0.5])
    omega = np.radians(5.0) * axis / np.linalg.norm(axis)
    for k in range(1001):
        jacobians, R_WT, place = flight.read()
        R_d = Rotation.from_rotvec(omega * k * STEP).as_matrix() @ R_first
        turn, error = Rotation.from_matrix(R_d @ R_WT.T).as_rotvec(), first - place
        errors.append((1e3 * np.linalg.norm(error), np.degrees(np.linalg.norm(turn))))
        drift = flight.drift
        rates = damped(jacobians[which], np.concatenate([omega + turn, error]))
        flight.advance(np.clip(rates, -1.5, 1.5))
    return *np.sqrt(np.mean(np.square(errors), axis=0)), drift


@pytest.mark.long
def test_a_tumbling_pose_is_held_with_the_generalized_jacobian():
    position, attitude, _ = held("fixed")
    assert position == pytest.approx(4.2666, abs=5.1e-5)
    assert attitude == pytest.approx(0.21997, abs=5.1e-6)
    position, attitude, drift = held("generalized")
    assert position == pytest.approx(0.0084, abs=5.1e-5)
    assert attitude == pytest.approx(0.00058, abs=5.1e-6)
    assert drift == pytest.approx(2.44, abs=5.1e-3)
