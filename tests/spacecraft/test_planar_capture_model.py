"""A planar arm with two links for studies of capture, and its published equations.

edwarddang02-crypto/Adaptive-Impedance-Control-for-Free-Floating-Space-Manipulator-Capture at
97d4d4a, ``models/RobotParameters.m`` and ``models/dynamics_model.m``. There is no licence, so that
the equations are read from a clone. Its figures of force tracking have no stated initial state, and
are not compared.
"""

import ast
import math
import operator
import re

import numpy as np
import pytest
from outside_data import outside_file
from outside_models import free_floating_scenario
from outside_urdfs import joint, link, robot
from planar_chain import PlanarChain

from ffsm_drake import make_true_plant

SOURCE = (
    "edwarddang02-crypto/Adaptive-Impedance-Control-for-Free-Floating-Space-Manipulator-Capture",
    "97d4d4a",
)
ROBOT = PlanarChain(
    masses=(11.891, 0.474, 1.195),
    inertias=(0.079, 0.013, 0.031),
    mount=(0.151, 0.0),
    lengths=(0.225, 0.276),
    centers=(0.1125, 0.138),
)
IN_PLANE = np.array([3, 4, 2, 6, 7])  # x, y, angle and joints of [w; v; joints]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    parts, parent, place = [], "base", ROBOT.mount[0]
    for k, (mass, inertia) in enumerate(zip(ROBOT.masses, ROBOT.inertias, strict=True)):
        name, center = (f"link_{k}", ROBOT.centers[k - 1]) if k else ("base", 0.0)
        parts.append(link(name, mass=mass, inertia=(inertia,) * 3, com=(center, 0.0, 0.0)))
        if k:
            parts.append(joint(f"joint_{k}", parent, name, xyz=f"{place} 0 0"))
            place = ROBOT.lengths[k - 1]
        parent = name
    scenario = free_floating_scenario(
        tmp_path_factory.mktemp("capture"), robot(*parts),
        last=("link_2", ROBOT.masses[2], (ROBOT.centers[1], 0, 0), [ROBOT.inertias[2]] * 3),
        joints={"joint_1": 0.3, "joint_2": -0.4},
    )  # fmt: skip
    return make_true_plant(scenario)


def ours(model, q, v):
    """Mass matrix (5, 5) and bias (5) in the plane."""
    full, rates = np.r_[np.cos(q[2] / 2), 0, 0, np.sin(q[2] / 2), q[:2], 0, q[3:]], np.zeros(8)
    rates[IN_PLANE] = v
    inertia = model.calc_mass_matrix(full)[np.ix_(IN_PLANE, IN_PLANE)]
    return inertia, model.calc_bias(full, rates)[IN_PLANE]


def states(count=20):
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield rng.uniform(-3.0, 3.0, 5), rng.normal(size=5)


OPERATORS = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Pow: operator.pow,
    ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip


def computed(node, names):
    """The number that an expression of numbers, names, sums, products, sin and cos stands for."""
    match node:
        case ast.Constant(value=float() | int() as number):
            return number
        case ast.Name(id=name):
            return names[name]
        case ast.UnaryOp(op=sign, operand=operand):
            return OPERATORS[type(sign)](computed(operand, names))
        case ast.BinOp(left=left, op=sign, right=right):
            return OPERATORS[type(sign)](computed(left, names), computed(right, names))
        case ast.Call(func=ast.Name(id="sin" | "cos" as name), args=[angle]):
            return getattr(math, name)(computed(angle, names))
    raise ValueError(f"an expression of another form: {ast.dump(node)}")


def theirs(q, v):
    """Their D (5, 5) and C (5), from the assignments of their file."""
    text = outside_file(*SOURCE, "models/dynamics_model.m")
    text = re.sub(r"\.\.\.\s*", "", text).replace("^", "**").replace("p.", "")
    names = dict(zip(("theta_b", "theta1", "theta2"), q[2:].tolist(), strict=True))
    names |= dict(zip(("dtheta_b", "dtheta1", "dtheta2"), v[2:].tolist(), strict=True))
    names |= dict(zip(("m_b", "m1", "m2", "I_b", "I1", "I2"), ROBOT.masses + ROBOT.inertias,
                      strict=True))  # fmt: skip
    names |= dict(zip(("l1", "l2", "a1", "a2"), ROBOT.lengths + ROBOT.centers, strict=True))
    names |= {"b_b": ROBOT.mount[0]}
    inertia, bias = np.zeros((5, 5)), np.zeros(5)
    for of, place, value in re.findall(r"^\s*([DC])\(([\d,]+)\)\s*=([^;\n]+);", text, re.MULTILINE):
        at = tuple(int(each) - 1 for each in place.split(","))
        of_entry = re.fullmatch(r"\s*D\((\d),(\d)\)\s*", value)
        if of_entry:
            inertia[at] = inertia[tuple(int(each) - 1 for each in of_entry.groups())]
        else:
            parsed = ast.parse(value.strip(), mode="eval").body
            (inertia if of == "D" else bias)[at] = computed(parsed, names)
    return inertia, bias


def test_the_plant_is_an_own_chain(model):
    for q, v in states():
        for found, expected in zip(ours(model, q, v), ROBOT.dynamics(q, v), strict=True):
            assert found == pytest.approx(expected, abs=1e-12)


def test_their_equations_differ_in_two_terms(model):
    """D(1, 4) has the angle of joint 2 for that of joint 1; C(4) has one sign turned."""
    m1, m2 = ROBOT.masses[1:]
    a1, a2 = ROBOT.centers
    for q, v in states():
        inertia, bias = (
            their - our for their, our in zip(theirs(q, v), ours(model, q, v), strict=True)
        )
        angle = m1 * a1 * (np.sin(q[2] + q[3]) - np.sin(q[2] + q[4]))
        sign = 2.0 * m2 * a2 * ROBOT.lengths[0] * v[4] ** 2 * np.sin(q[4])
        expected = np.zeros((5, 5))
        expected[[0, 3], [3, 0]] = angle
        assert inertia == pytest.approx(expected, abs=1e-12)
        assert bias == pytest.approx([0.0, 0.0, 0.0, sign, 0.0], abs=1e-12)
