"""Backlash of a flexible gear, against the piecewise solution of two free bodies, and limit cycles
against the describing function.
"""

import os

import numpy as np
import pytest
from c_code import needs_llvm
from compared_runs import check
from entry_points import needs
from refusals import assert_refused
from scipy.linalg import expm
from scipy.optimize import brentq

from ffsm_drake import simulate
from ffsm_drake.scenario import scenario_from_dict

ROTOR, LINK, BASE = 2.0, 5.0, 10.0  # kg m^2 about the axis; the link with its payload
INERTIAL = (
    '<inertial><mass value="{m}"/><inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" '
    'iyz="0"/></inertial>'
)
SERVICER = f"""<robot name="two_bodies">
  <link name="base">{INERTIAL.format(m=100, i=BASE)}</link>
  <link name="arm">{INERTIAL.format(m=5, i=2)}</link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/></joint>
</robot>"""
DEBRIS = f'<robot name="debris"><link name="debris">{INERTIAL.format(m=20, i=3)}</link></robot>'


@pytest.fixture(scope="module")
def geared(tmp_path_factory):
    """geared(stiffness, gap, ...) -> a scenario with a constant torque between base and rotor."""
    folder = tmp_path_factory.mktemp("geared")
    for name, text in (("servicer", SERVICER), ("debris", DEBRIS)):
        (folder / f"{name}.urdf").write_text(text)

    def make(stiffness, gap, torque, *, duration=2.0, gains=1e-9, seed=0, k_p=None, **further):
        payload = {"mass": 20.0, "center_of_mass": [0, 0, 0], "inertia": [3.0, 3.0, 3.0]}
        gear = {"kind": "gear", "joint": "hinge", "stiffness": stiffness, "damping_ratio": 0.0}
        return scenario_from_dict(
            {
                "duration": duration,
                "random_seed": seed,
                "controller": "pd_plus",
                "controllers": {"pd_plus": {"k_d": gains, "k_p": k_p or gains}},
                "model": {
                    "servicer": str(folder / "servicer.urdf"),
                    "debris": str(folder / "debris.urdf"),
                    "directives": None,
                    "end_effector": "servicer::arm",
                    "grasp": "debris::debris",
                    "flexible": {"gear": gear},
                },
                "simulator_config": {"max_step_size": further.get("step", 2.5e-4)},
                "payload": {"truth": payload, "nominal": payload},
                "sensing": {"position_noise": 0.0, "velocity_noise": 0.0},
                "disturbance": {"harmonics": {"hinge": {"bias": torque}}},
                "actuation": {
                    "drives": {"rotor_inertia": {"hinge": ROTOR}},
                    "delay": further.get("delay", 0),
                },
                "initial_velocity": {"hinge": further.get("speed", 0.0)},
                "effects": {"backlash": {"gap": {"gear": gap}}},
            }
        )

    return make


def angles(times, stiffness, gap, torque):
    """The angle of the gear, rad: free flight and half cycles of a spring in turn.

    In the gap, the torque T turns the rotor (J) alone, so the angle falls with T / J. In contact,
    it is an oscillator with 1 / I = 1 / J + 1 / link + 1 / base and the same constant part.
    """
    pull = torque / ROTOR
    rate = np.sqrt(stiffness * (1.0 / ROTOR + 1.0 / LINK + 1.0 / BASE))
    speed = np.sqrt(2.0 * pull * 0.5 * gap)  # at the first contact
    first, mean = speed / pull, pull / rate**2
    # of the contact: -mean (1 - cos) - speed / rate sin is zero again at twice this angle
    contact = 2.0 * (np.pi - np.arctan2(speed / rate, mean)) / rate
    flight = 2.0 * speed / pull  # against the pull, and back; it does not reach the other side
    assert speed**2 / (2.0 * pull) <= gap
    found = np.where(times < first, -0.5 * pull * times**2, np.nan)
    since = (times - first) % (contact + flight)
    in_contact = -mean * (1.0 - np.cos(rate * since)) - speed / rate * np.sin(rate * since)
    free = since - contact
    flying = speed * free - 0.5 * pull * free**2
    after = -0.5 * gap + np.where(since < contact, in_contact, flying)
    return np.where(times < first, found, after)


@pytest.mark.smoke
@pytest.mark.parametrize("seed", range(int(os.environ.get("BACKLASH_DRAWS", "4"))))
def test_free_travel_and_contact_are_those_of_the_piecewise_solution(geared, seed):
    """Of drawn stiffness, gap and torque, to 1e-4 of the gap over several contacts."""
    draw = np.random.default_rng(seed)
    stiffness, gap = draw.uniform(200.0, 2000.0), draw.uniform(2e-3, 2e-2)
    torque = draw.uniform(0.2, 1.0)
    record = simulate(geared(stiffness, gap, torque), check_stability=False, engine="drake")
    data = record.dataset
    expected = angles(data["time"].values, stiffness, gap, torque)
    found = data["hidden_position"].values[:, 0]
    assert np.abs(found - expected).max() < 1e-4 * gap
    assert record.metrics["backlash"]["contacts"]["gear"] >= 2
    share = (np.abs(expected) < 0.5 * gap).mean()
    assert record.metrics["backlash"]["in_gap"]["gear"] == pytest.approx(share, abs=0.02)


@needs("compiled")
@needs_llvm
@pytest.mark.slow
def test_compiled_runs_are_those_of_drake(geared):
    check([geared(500.0, 5e-3, 0.5, duration=0.6, gains=5.0, seed=k) for k in range(2)])


LAG, PERIOD = 5, 0.01  # samples of the force, s


def slowest(stiffness, k_p, k_d):
    """The eigenvalue of the sampled loop with the largest modulus, of a gear without a gap.

    Coordinates: angle of the base, of the rotor from the base, and of the gear. The force of the
    rotor acts after the lag. The angle of the base is free, and its rate has the eigenvalue 1.
    """
    inertia = np.array([[BASE + LINK, LINK, LINK], [LINK, ROTOR + LINK, LINK], [LINK, LINK, LINK]])
    rates = np.zeros((7, 7))
    rates[:3, 3:6], rates[3:6, 6] = np.eye(3), np.linalg.solve(inertia, [0.0, 1.0, 0.0])
    rates[3:6, :3] = -np.linalg.solve(inertia, np.diag([0.0, 0.0, stiffness]))
    sample, loop = expm(PERIOD * rates), np.zeros((6 + LAG, 6 + LAG))
    loop[:6, :6], loop[:6, -1] = sample[:6, :6], sample[:6, 6]
    loop[6, 1], loop[6, 4] = -k_p, -k_d
    loop[7:, 6:-1] = np.eye(LAG - 1)
    found = np.linalg.eigvals(loop[1:, 1:])
    found = found[np.abs(found - 1.0) > 1e-7]
    return found[np.argmax(np.abs(found))]


def describing(ratio):
    """Stiffness of a dead band of half width b at the amplitude A, as a share of that without it;
    ratio = b / A (A. Gelb and W. E. Vander Velde, Multiple-Input Describing Functions, 1968).
    """
    return 1.0 - 2.0 / np.pi * (np.arcsin(ratio) + ratio * np.sqrt(1.0 - ratio**2))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(int(os.environ.get("BACKLASH_DRAWS", "4"))))
def test_limit_cycles_are_those_of_the_describing_function(geared, seed):
    """A late rotor loop is unstable within the gap, and stable with the spring. Amplitude and
    frequency of the limit cycle follow from the stiffness at which the loop is marginal.
    """
    draw = np.random.default_rng(seed)
    lag, crossing = (LAG + 0.5) * PERIOD, draw.uniform(1.7, 2.4)
    k_d = ROTOR * crossing / lag
    k_p = draw.uniform(0.05, 0.15) * k_d * crossing / lag
    marginal = brentq(lambda value: abs(slowest(value, k_p, k_d)) - 1.0, 7e3, 1.6e4)
    share, gap = draw.uniform(0.6, 0.85), draw.uniform(2e-3, 1e-2)
    stiffness = marginal / share
    assert abs(slowest(stiffness, k_p, k_d)) < 1.0 < abs(slowest(0.5 * marginal, k_p, k_d))
    amplitude = 0.5 * gap / brentq(lambda ratio: describing(ratio) - share, 1e-6, 1.0)
    turn = abs(np.angle(slowest(marginal, k_p, k_d))) / PERIOD  # rad/s
    scenario = geared(
        stiffness, gap, 0.0, duration=12.0, gains={"all": 1e-9, "joints": k_d},
        k_p={"all": 1e-9, "joints": k_p}, delay=LAG, speed=30.0 * gap, step=1e-3,
    )  # fmt: skip
    data = simulate(scenario, check_stability=False, engine="drake").dataset
    late = data["time"].values >= 8.0
    time, angle = data["time"].values[late], data["hidden_position"].values[late, 0]
    rates = np.linspace(0.9 * turn, 1.1 * turn, 401)
    lines = np.abs(np.exp(-1j * np.outer(rates, time)) @ (angle - angle.mean()))
    first = 2.0 * lines.max() / time.size  # amplitude of the first harmonic
    assert first == pytest.approx(amplitude, rel=0.02)
    assert rates[np.argmax(lines)] == pytest.approx(turn, rel=2e-3)


def test_an_unknown_gear_is_refused():
    gear = [
        "actuation.drives.rotor_inertia={joint_3: 20}",
        "model.flexible={elbow: {kind: gear, joint: joint_3, stiffness: 1.0e5}}",
    ]
    problem = "effects.backlash.gap.knee: is no flexible gear; there are: elbow"
    assert_refused(problem, "postcapture", *gear, "effects.backlash.gap={knee: 0.001}")
    problem = "effects.backlash.gap.elbow: must be > 0, below 1 rad, not 0"
    assert_refused(problem, "postcapture", *gear, "effects.backlash.gap={elbow: 0}")
    problem = "effects.backlash: cannot be combined with faults"
    given = ["effects.backlash.gap={elbow: 0.001}", "faults={}"]
    assert_refused(problem, "postcapture", *gear, *given)
