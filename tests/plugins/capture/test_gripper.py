"""The contact of a closing gripper: MuJoCo's friction between pads, and laws of mechanics."""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from ffsm_drake.plugins.capture.contact_force import Jaws
from ffsm_drake.scenario.capture import Closing, Compliance

PAD = 0.05  # m, half of a square pad, whose corners touch in MuJoCo
GRIPPER = 60.0  # kg, with moments of 6 kg m^2
REACH = 0.1  # m
END = 1.0  # s
# MuJoCo's pads are rigid; springs stretch by force / stiffness.
STIFF = Compliance(stiffness=1e7, damping=1e4, rotational_stiffness=1e6, rotational_damping=1e3)


def mujoco_slide(closing: Closing, *, mass: float, arm: float, rate: np.ndarray) -> np.ndarray:
    """The target's offset at every ms (n, 6) between two pads that a force presses on it, which
    grows as the jaws close; ``arm`` (m) from the grasp to its centre of mass, along z.
    """
    inertia = mass / 10.0
    jaw = """<body pos="0 {0} 0"><joint type="slide" axis="0 {1} 0"/>
        <geom type="box" size="{2} 0.01 {2}" mass="0.01" friction="{3} 0 0"/></body>"""
    jaws = "".join(jaw.format(s * 0.03, -s, PAD, closing.friction) for s in (1, -1))
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco><option gravity="0 0 0" timestep="5e-4" cone="elliptic" impratio="100"
          solver="Newton" iterations="200" tolerance="1e-12"/>
        <default><geom solref="0.002 1" solimp="0.99 0.999 0.0001"/></default>
        <worldbody>
          <body name="gripper"><freejoint/>
            <inertial pos="0 0 0" mass="{GRIPPER}" diaginertia="6 6 6"/>{jaws}</body>
          <body name="target"><freejoint/>
            <inertial pos="0 0 {arm}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
            <geom type="box" size="0.4 0.02 0.4" friction="{closing.friction} 0 0"/></body>
        </worldbody></mujoco>""")
    data, jaws_of = mujoco.MjData(model), Jaws.of(closing, STIFF)
    target = model.body("target").dofadr[0]
    data.qvel[target : target + 3], data.qvel[target + 3 : target + 6] = rate[3:], rate[:3]
    offsets = []
    for step in range(round(END / 5e-4)):
        data.qfrc_applied[6:8] = closing.preload * jaws_of.closed(data.time)[0]
        mujoco.mj_step(model, data)
        if step % 2 == 1:
            gripper, held = data.body("gripper"), data.body("target")
            R = gripper.xmat.reshape(3, 3)
            turn = R.T @ held.xmat.reshape(3, 3)
            vector = 0.5 * np.array(
                [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
            )
            offsets.append([*vector, *R.T @ (held.xpos - gripper.xpos)])
    return np.array(offsets)


def sliding(jaws, mobility, offset, rate, steps):
    """Offset, rate and force after each step of a millisecond, from a first contact at zero."""
    slid = np.zeros(6)
    for step in range(steps):
        force, slid = jaws.act(
            1e-3 * (step + 1),
            1e-3,
            start=np.zeros(6),
            offset=offset,
            rate=rate,
            slid=slid,
            mobility=mobility,
        )
        rate = rate + 1e-3 * mobility @ force
        offset = offset + 1e-3 * rate
        yield offset, rate, force


def own_slide(closing: Closing, *, mass: float, arm: float, rate: np.ndarray) -> np.ndarray:
    """The same by ``Jaws``."""
    jaws = Jaws.of(closing, STIFF)
    mobility = np.diag([10.0 / mass + 1.0 / 6.0] * 3 + [1.0 / mass + 1.0 / GRIPPER] * 3)
    cross = np.array([[0.0, arm, 0.0], [-arm, 0.0, 0.0], [0.0, 0.0, 0.0]])  # -[arm z] x
    mobility[:3, 3:] = 10.0 / mass * cross
    mobility[3:, :3] = mobility[:3, 3:].T
    mobility[3:, 3:] += 10.0 / mass * cross.T @ cross
    return np.array([offset for offset, *_ in sliding(jaws, mobility, np.zeros(6), rate, 1000)])


def outcome(offsets: np.ndarray, rest: float = 0.01) -> str:
    if (np.linalg.norm(offsets[:, 3:], axis=1) > REACH).any():
        return "slipped"
    last = (offsets[-1] - offsets[-11]) / 0.01
    return "held" if max(np.linalg.norm(last.reshape(2, 3), axis=1)) < rest else "slipped"


CASES = [  # preload, friction, closing time, mass, arm, rate (about y; along x, z), outcome
    (200.0, 0.3, 0.2, 100.0, 0.0, (0.0, 0.05, 0.0), "held"),
    (50.0, 0.3, 0.2, 100.0, 0.0, (0.0, 0.10, 0.0), "held"),
    (20.0, 0.2, 0.3, 100.0, 0.0, (0.0, 0.20, 0.0), "slipped"),
    (500.0, 0.5, 0.1, 300.0, 0.0, (0.0, 0.30, -0.20), "held"),
    (30.0, 0.3, 0.5, 17.0, 0.0, (0.0, 0.15, 0.0), "held"),
    (30.0, 0.1, 0.5, 300.0, 0.0, (0.0, 0.12, 0.12), "slipped"),
    (100.0, 0.3, 0.2, 100.0, 0.0, (0.30, 0.0, 0.0), "held"),
    (400.0, 0.4, 0.1, 30.0, 0.0, (-0.50, 0.0, 0.0), "held"),
    (5.0, 0.2, 0.3, 200.0, 0.0, (0.30, 0.0, 0.0), "slipped"),
    (300.0, 0.3, 0.2, 100.0, 0.3, (0.0, 0.08, 0.0), "held"),
]


@pytest.mark.parametrize(("preload", "friction", "time", "mass", "arm", "rate", "end"), CASES)
def test_it_slides_and_holds_as_mujocos_pads(preload, friction, time, mass, arm, rate, end):
    closing = Closing(
        preload=preload,
        friction=friction,
        time=time,
        radius=np.sqrt(2.0) * PAD,
        axis=[0.0, 1.0, 0.0],  # pads only
    )
    rates = np.array([0.0, rate[0], 0.0, rate[1], 0.0, rate[2]])
    given = {"mass": mass, "arm": arm, "rate": rates}
    theirs, own = mujoco_slide(closing, **given), own_slide(closing, **given)
    assert outcome(own) == outcome(theirs) == end
    way = np.abs(theirs[-1])
    assert_allclose(own[-1], theirs[-1], atol=0.05 * way.max() + 3e-4)


def test_the_palm_pushes_only_and_the_target_bounces_off():
    closing = Closing(time=100.0, preload=1e-3)
    jaws = Jaws.of(closing, Compliance())
    mobility = np.diag([0.1] * 3 + [1.0 / 50.0] * 3)
    along = np.eye(6)[5]
    found = [*sliding(jaws, mobility, 1e-3 * along, -0.05 * along, 500)]
    (offset, rate, _), forces = found[-1], [force[5] for *_, force in found]
    assert 0.01 < rate[5] < 0.05  # thrown back, with less energy
    assert min(forces) > -0.01
    assert max(forces) > 10.0
    assert offset[5] > 0.0


def test_the_force_keeps_to_what_friction_bears():
    rng = np.random.default_rng(0)
    for _ in range(200):
        closing = Closing(preload=10 ** rng.uniform(-1, 3), radius=10 ** rng.uniform(-2, 0))
        jaws, start = Jaws.of(closing, Compliance()), 0.02 * rng.standard_normal(6)
        root = rng.standard_normal((6, 6)) * 10 ** rng.uniform(-2, 1.2, 6)[:, None]
        time = rng.uniform(0.05, 1.0)
        offset, rate = start + 0.01 * rng.random(6), 0.3 * rng.standard_normal(6)
        mobility = root @ root.T
        force, slid = jaws.act(
            time, 1e-3, start=start, offset=offset, rate=rate, slid=np.zeros(6), mobility=mobility
        )
        force[5] = 0.0  # along the palm's axis
        share = np.linalg.norm(force / np.repeat(jaws.limits(time), 3))
        assert share <= 1.0 + 1e-6
        assert np.isfinite(slid).all()
