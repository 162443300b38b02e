"""A closed loop of the joints turns a free Panda, as in amoeinn/free-floating-manipulation (2026).

``examples/verify_nonholonomy.py`` there: joints 2 and 3 trace 0.6 sin, 0.6 (1 - cos) and return;
the base, of 0.63 kg, ends 18.9798 deg from where it began at its finest step, in the limit of small
steps 18.982 deg. Masses and inertias are those that Gaz et al. identified, as
moveit/moveit_resources has them (``panda_description/urdf/panda.urdf.xacro``), where the right
finger has ten times the mass of the left.
"""

import functools
import tempfile
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ffsm_drake import free_floating, load_scenario, make_true_plant

# Link: mass, centre, xx, yy, zz, xy, xz, yz; its joint's place and roll on the link before.
LINKS = (
    (0.629769, (-0.041018, -0.00014, 0.049974),
     (0.00315, 0.00388, 0.004285, 8.2904e-7, 0.00015, 8.2299e-6), None, 0.0),
    (4.970684, (0.003875, 0.002081, -0.04762),
     (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169), "0 0 0.333", 0.0),
    (0.646926, (-0.003141, -0.02872, 0.003495),
     (0.007962, 2.811e-2, 2.5995e-2, -3.925e-3, 1.0254e-2, 7.04e-4), "0 0 0", -90.0),
    (3.228604, (2.7518e-2, 3.9252e-2, -6.6502e-2),
     (3.7242e-2, 3.6155e-2, 1.083e-2, -4.761e-3, -1.1396e-2, -1.2805e-2), "0 -0.316 0", 90.0),
    (3.587895, (-5.317e-2, 1.04419e-1, 2.7454e-2),
     (2.5853e-2, 1.9552e-2, 2.8323e-2, 7.796e-3, -1.332e-3, 8.641e-3), "0.0825 0 0", 90.0),
    (1.225946, (-1.1953e-2, 4.1065e-2, -3.8437e-2),
     (3.5549e-2, 2.9474e-2, 8.627e-3, -2.117e-3, -4.037e-3, 2.29e-4), "-0.0825 0.384 0", -90.0),
    (1.666555, (6.0149e-2, -1.4117e-2, -1.0517e-2),
     (1.964e-3, 4.354e-3, 5.433e-3, 1.09e-4, -1.158e-3, 3.41e-4), "0 0 0", 90.0),
    (7.35522e-1, (1.0517e-2, -4.252e-3, 6.1597e-2),
     (1.2516e-2, 1.0027e-2, 4.815e-3, -4.28e-4, -1.19e-3, -7.41e-4), "0.088 0 0", 90.0),
)  # fmt: skip
HAND = {"mass": 0.73, "center_of_mass": [-0.01, 0.0, 0.03], "inertia": [0.001, 0.0025, 0.0017]}
FINGERS = {"left": 0.015, "right": 0.15}
FINGER = (2.375e-6, 2.375e-6, 7.5e-7, 0.0, 0.0, 0.0)


def link(name, mass, center, inertia):
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    moments = " ".join(f'{key}="{value}"' for key, value in zip(names, inertia, strict=True))
    place = " ".join(map(str, center))
    return (
        f'<link name="{name}"><inertial><origin xyz="{place}"/><mass value="{mass}"/>'
        f"<inertia {moments}/></inertial></link>"
    )


def joint(kind, parent, child, place, rpy="0 0 0"):
    return (
        f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}" rpy="{rpy}"/><axis xyz="0 0 1"/></joint>'
    )


@functools.cache
def panda():
    parts = [link("link0", *LINKS[0][:3])]
    for i, (mass, center, inertia, place, roll) in enumerate(LINKS[1:], start=1):
        parts.append(link(f"link{i}", mass, center, inertia))
        rpy = f"{np.radians(roll)} 0 0"
        parts.append(joint("continuous", f"link{i - 1}", f"link{i}", place, rpy))
    turn = f"0 0 {-np.pi / 4.0}"
    parts.append(link("hand", 0.1, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1, 0.0, 0.0, 0.0)))
    parts.append(joint("fixed", "link7", "hand", "0 0 0.107", turn))
    for name, mass in FINGERS.items():
        parts.append(link(name, mass, (0.0, 0.0, 0.0), FINGER))
        parts.append(joint("fixed", "hand", name, "0 0 0.0584"))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "panda.urdf").write_text(f'<robot name="panda">{"".join(parts)}</robot>')
        (Path(folder) / "panda.dmd.yaml").write_text(
            f"directives:\n- add_model:\n    name: panda\n    file: file://{folder}/panda.urdf\n"
        )
        postures = {f"to_link{i}": 0.0 for i in range(1, 8)}
        return make_true_plant(
            load_scenario(
                "postcapture",
                [
                    f"model.directives={folder}/panda.dmd.yaml", "model.end_effector=panda::hand",
                    f"payload={{body: 'panda::hand', truth: {HAND}, nominal: {HAND}}}",
                    f"initial_posture.joints={postures}", f"target_posture.joints={postures}",
                    "disturbance.amplitude_scale=0",
                ],
            )
        )  # fmt: skip


def turned(direction=1.0, R_WB=np.eye(3)):  # noqa: B008
    """R_WB after the loop, once around, with momentum conserved at zero."""
    home = np.array([0.0, -0.3, 0.0, -1.8, 0.0, 1.5, 0.0])

    def rate(phase, quaternion):
        joints, rates = home.copy(), np.zeros(7)
        joints[1:3] += 0.6 * np.sin(phase), 0.6 * (1.0 - np.cos(phase))
        rates[1:3] = 0.6 * np.cos(phase), 0.6 * np.sin(phase)
        unit = quaternion / np.linalg.norm(quaternion)
        q = np.concatenate([unit, np.zeros(3), joints])
        w, x, y, z = unit
        turn = free_floating(panda(), q).velocity(rates)[:3]
        half = np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])
        return 0.5 * half @ turn

    x, y, z, w = Rotation.from_matrix(R_WB).as_quat()
    way = solve_ivp(
        rate, (0.0, direction * 2.0 * np.pi), [w, x, y, z], method="DOP853", rtol=1e-11, atol=1e-12
    )
    return Rotation.from_quat(way.y[[1, 2, 3, 0], -1]).as_matrix()


def angle(R):
    return np.degrees(Rotation.from_matrix(R).magnitude())


@pytest.mark.smoke
def test_it_has_the_mass_of_theirs():
    assert panda().plant.CalcTotalMass(panda().context) == pytest.approx(17.5869, abs=5e-5)


@pytest.mark.slow
def test_a_closed_loop_of_the_joints_turns_the_base():
    R_forth = turned()
    assert angle(R_forth) == pytest.approx(18.982, abs=5.1e-4)
    # theirs return to 0.0131 deg
    assert angle(turned(-1.0, R_forth)) < 1e-6
