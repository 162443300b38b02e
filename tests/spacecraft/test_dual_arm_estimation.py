"""Two arms and three wheels for 40 s: naveen13m/space_robot_parameter_estimation at 876ba96.

``dual_arm_articulate/statevar_1.dat`` in ``src/performance_evaluation/state_comparision_plots`` has
801 rows with the motion of the base (ReDySim) for given motions of the joints; the numbers of the
model are those of ``test_case_data/dual_arm_articulate``. There is no licence, so that the file is
read from a clone. The position there is that of a sensor at (-0.2, -0.3, -0.4) m of the base, which
is not stated for this file. It is found here from the data.

The inertias of six links are of no body, and the package refuses them. Own momenta (NumPy) with the
published numbers have the published motion; with the nearest inertias of bodies, they have that of
the package.
"""

import functools
import itertools

import numpy as np
import pytest
from outside_data import outside_file
from outside_models import free_floating_scenario
from outside_urdfs import robot
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from ffsm_drake import FfsmError, free_floating, make_true_plant

SOURCE = ("naveen13m/space_robot_parameter_estimation", "876ba96")
FOLDER = "src/performance_evaluation/state_comparision_plots/dual_arm_articulate"
pytestmark = pytest.mark.filterwarnings("ignore:Gimbal lock")
SENSOR = np.array([-0.2, -0.3, -0.4])  # m
# Parent, x, z, twist (modified Denavit-Hartenberg), mass, centre of mass, inertia xx, yy, zz, xy,
# yz, zx. Body 9 has no mass, and its joint is at a quarter turn.
QUARTER = np.pi / 2.0
BODIES = (
    (-1, 0, 0, 0, 2000, (0, 0, 0), (1200, 1200, 1200, 35.52, 40.45, 45.71)),
    (0, 0.5, 0.5, 0, 50, (0.6, 0.05, -0.07), (3.1, 1.89, 20.51, 1.9, 3.65, 3.9)),
    (1, 1, 0, QUARTER, 40, (0.4, -0.04, -0.05), (1.15, 1.68, 18.67, 0.61, 1.75, 1.5)),
    (2, 1, 0, 0, 30, (0.7, 0.4, 0.3), (24.45, 28.56, 35.53, 9.78, 9.1, 10.23)),
    (0, -0.5, 0.5, 0, 50, (0.55, 0.04, -0.04), (1.85, 1.62, 17.05, 1.5, 2.25, 3.71)),
    (4, 1, 0, QUARTER, 35, (0.45, 0.05, 0.05), (2.55, 1.84, 14.28, 2.9, 1.55, 1.27)),
    (5, 1, 0, 0, 60, (0.6, -0.5, -0.35), (12.24, 31.45, 23.77, 9.1, 8.52, 8.67)),
    (0, -0.3, 0, 0, 20, (0, 0, 0), (1, 1, 2, 0, 0, 0)),
    (0, -0.3, 0, QUARTER, 20, (0, 0, 0), (1, 1, 2, 0, 0, 0)),
    (0, -0.3, 0, QUARTER, 0, (0, 0, 0), (0, 0, 0, 0, 0, 0)),
    (9, 0, 0, QUARTER, 20, (0, 0, 0), (1, 1, 2, 0, 0, 0)),
)
MOVED = [0, 1, 2, 3, 4, 5, 6, 7, 9]  # joints, without the one at a quarter turn


def tensor(moments):
    xx, yy, zz, xy, yz, zx = moments
    return np.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]], dtype=float)


def about_x(angle):
    return Rotation.from_euler("x", angle).as_matrix()


def nearest(inertia):
    """The nearest inertia of a body: of its second moments, the negative ones become 1e-3."""
    moments, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    if moments.min() >= 0.0:
        return inertia
    second = axes @ np.diag(np.maximum(moments, 1e-3)) @ axes.T
    return np.trace(second) * np.eye(3) - second


PUBLISHED = [tensor(moments) for *_, moments in BODIES]
NEAREST = [nearest(each) for each in PUBLISHED]


def urdf(inertias):
    parts = []
    for k, (body, inertia) in enumerate(zip(BODIES, inertias, strict=True)):
        parent, x, z, twist, mass, center, _ = body
        place = f"{x} {-z * np.sin(twist)} {z * np.cos(twist)}"
        entries = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "iyz": (1, 2)}
        own = " ".join(f'{key}="{inertia[at]}"' for key, at in (*entries.items(), ("ixz", (0, 2))))
        parts.append(
            f'<link name="body_{k}"><inertial><origin xyz="{center[0]} {center[1]} {center[2]}"/>'
            f'<mass value="{mass}"/><inertia {own}/></inertial></link>'
            if mass
            else f'<link name="body_{k}"/>'
        )
        if k:
            kind, turn = ("continuous", 0.0) if mass else ("fixed", QUARTER)
            R = about_x(twist) @ Rotation.from_euler("z", turn).as_matrix()
            rpy = QUARTER * np.round(Rotation.from_matrix(R).as_euler("xyz") / QUARTER)
            parts.append(
                f'<joint name="joint_{k}" type="{kind}"><parent link="body_{parent}"/><child '
                f'link="body_{k}"/><origin xyz="{place}" rpy="{rpy[0]} {rpy[1]} {rpy[2]}"/><axis '
                'xyz="0 0 1"/></joint>'
            )
    return robot(*parts)


def plant(folder, inertias):
    moments = inertias[6]
    last = [float(moments[at]) for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    joints = {f"joint_{k + 1}": 0.0 for k in MOVED}
    return make_true_plant(
        free_floating_scenario(
            folder, urdf(inertias), last=("body_6", 60.0, BODIES[6][5], last), joints=joints
        )
    )


def momenta(inertias, R_WB, angles):
    """Linear and angular momentum about the base per velocity and rate of the base (6, 6), and per
    joint rate (6, 10), with NumPy only.
    """
    turns, places, axes = [R_WB], [np.zeros(3)], []
    of_base, of_joints = np.zeros((6, 6)), np.zeros((6, 10))
    for k, (parent, x, z, twist, mass, center, _) in enumerate(BODIES):
        if k:
            arm = np.array([x, -z * np.sin(twist), z * np.cos(twist)])
            places.append(places[parent] + turns[parent] @ arm)
            cosine, sine = np.cos(angles[k - 1]), np.sin(angles[k - 1])
            about_z = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
            turns.append(turns[parent] @ about_x(twist) @ about_z)
        axes.append(turns[k][:, 2])
        at, spin = places[k] + turns[k] @ center, turns[k] @ inertias[k] @ turns[k].T
        lever = np.cross(np.eye(3), at)  # [at]x
        move = np.hstack([np.eye(3), -lever])
        of_base += np.vstack([mass * move, mass * lever @ move])
        of_base[3:, 3:] += spin
        link = k
        while link:
            moved = mass * np.cross(axes[link], at - places[link])
            of_joints[:, link - 1] += np.r_[moved, spin @ axes[link] + np.cross(at, moved)]
            link = BODIES[link][0]
    return of_base, of_joints


def by_momentum(inertias, quaternion, angles, rates):
    of_base, of_joints = momenta(inertias, Rotation.from_quat(quaternion).as_matrix(), angles)
    return -np.linalg.solve(of_base, of_joints @ rates)


def by_package(model, quaternion, angles, rates):
    q = np.r_[quaternion[[3, 0, 1, 2]], np.zeros(3), angles[MOVED]]
    turn_and_move = free_floating(model, q).velocity(rates[MOVED])[:6]
    return turn_and_move[[3, 4, 5, 0, 1, 2]]


def flown(times, angles, base_velocity):
    """Positions (n, 3) and attitudes (n) of the base, by steps of RK4 from row to row."""

    def rate(time, state):
        *_, x, y, z, w = state
        twist = base_velocity(state[3:] / np.linalg.norm(state[3:]), angles(time), angles(time, 1))
        half = 0.5 * np.array([[w, z, -y], [-z, w, x], [y, -x, w], [-x, -y, -z]])
        return np.r_[twist[:3], half @ twist[3:]]

    states = [np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])]
    for start, end in itertools.pairwise(times):
        step, state = end - start, states[-1]
        one = rate(start, state)
        two = rate(start + step / 2, state + step / 2 * one)
        three = rate(start + step / 2, state + step / 2 * two)
        four = rate(end, state + step * three)
        states.append(state + step / 6 * (one + 2 * two + 2 * three + four))
    states = np.array(states)
    return states[:, :3], Rotation.from_quat(states[:, 3:])


@functools.cache
def published():
    """Times, positions, attitudes, and the angles of the joints as a function of time."""

    def read(name):
        lines = outside_file(*SOURCE, f"{FOLDER}/{name}_1.dat").split("\n")
        return np.array([line.split() for line in lines if line.strip()], dtype=float)

    times, states = read("timevar")[:, 0], read("statevar")
    states[:, 6 + 8] = QUARTER  # which the file rounds
    angles = CubicHermiteSpline(times, states[:, 6:16], states[:, 22:])
    return times, states[:, :3], Rotation.from_euler("ZXY", states[:, 3:6]), angles


def test_the_published_inertias_are_of_no_body(tmp_path):
    with pytest.raises(FfsmError, match="triangle inequality"):
        plant(tmp_path, PUBLISHED)
    wrong = [k for k, (one, other) in enumerate(zip(PUBLISHED, NEAREST, strict=True))
             if not np.allclose(one, other, atol=1e-9)]  # fmt: skip
    assert wrong == [1, 2, 3, 4, 5, 6]


@pytest.mark.long
def test_own_momenta_have_the_published_motion():
    times, position, attitude, angles = published()
    place, turned = flown(times, angles, functools.partial(by_momentum, PUBLISHED))
    assert (turned.inv() * attitude).magnitude() == pytest.approx(0.0, abs=1e-6)
    assert place + turned.apply(SENSOR) - SENSOR == pytest.approx(position, abs=1e-6)
    assert position[-1] == pytest.approx([-0.078633, 0.049067, 0.003976], abs=1e-6)
    bent = (turned.as_matrix() - np.eye(3)).reshape(-1, 3)
    sensor = np.linalg.lstsq(bent, (position - place).ravel(), rcond=None)[0]
    assert sensor == pytest.approx(SENSOR, abs=1e-5)


@pytest.mark.long
def test_the_package_has_the_motion_of_own_momenta(tmp_path):
    """With inertias of bodies. The end is then 7.7 mm and 0.81 deg from the published one."""
    times, position, attitude, angles = published()
    model = plant(tmp_path, NEAREST)
    place, turned = flown(times, angles, functools.partial(by_package, model))
    own = flown(times[:201], angles, functools.partial(by_momentum, NEAREST))  # 10 s
    assert place[:201] == pytest.approx(own[0], abs=1e-12)
    assert (turned[:201].inv() * own[1]).magnitude() == pytest.approx(0.0, abs=1e-11)
    seen = place[-1] + turned[-1].apply(SENSOR) - SENSOR
    assert np.linalg.norm(seen - position[-1]) == pytest.approx(7.7e-3, rel=0.02)
    off = (turned[-1].inv() * attitude[-1]).magnitude()
    assert np.degrees(off) == pytest.approx(0.81, rel=0.02)
