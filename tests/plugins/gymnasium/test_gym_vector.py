"""Several spacecraft in one environment, compiled or on Drake: the results of single ones.

``FFSM_DRAWS=100 pytest -m "slow or not slow"`` on this file compares as many drawn environments.
"""

import os

import numpy as np
import pytest

from ffsm_drake import FfsmError, load_scenario

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium, an extra")

import ffsm_drake.plugins.gymnasium  # noqa: E402, F401
from ffsm_drake.plugins.gymnasium.vector import MissionVectorEnv  # noqa: E402
from ffsm_drake.spacecraft.craft import make_nominal_plant  # noqa: E402

DRAWS = int(os.environ.get("FFSM_DRAWS", "2"))


def made(name="ffsm/PostCapture-v0", mode="vector_entry_point", **settings):
    return gymnasium.make_vec(name, num_envs=3, vectorization_mode=mode, **settings)


@pytest.mark.smoke
@pytest.mark.parametrize("action", ["force", "residual"])
def test_every_copy_on_drake_has_the_bits_of_a_single_one(action):
    settings = {"action": action, "overrides": ("duration=0.1",), "samples_per_step": 3}
    wide, alone = made(**settings, engine="drake"), made(**settings, mode="sync")
    draw, cuts = np.random.default_rng(1), 0
    assert wide.engine == "drake"
    np.testing.assert_array_equal(wide.reset(seed=3)[0], alone.reset(seed=3)[0])
    for _ in range(12):
        actions = draw.uniform(-0.05, 0.05, wide.action_space.shape).astype(np.float32)
        (*found, info), (*expected, own) = (env.step(actions) for env in (wide, alone))
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)
        assert_equal_info(info, own, exact=True)
        cuts += found[3].any()
    assert cuts == 2
    wide.close()


def assert_equal_info(info, expected, exact=False):
    assert info.keys() == expected.keys()
    for name, values in expected.items():
        if isinstance(values, dict):
            assert_equal_info(info[name], values, exact)
        elif values.dtype == float and not exact:
            np.testing.assert_allclose(info[name], values, rtol=1e-7, atol=1e-9)
        else:
            np.testing.assert_array_equal(info[name], values)


LAWS = ("tvlqr", "tdc", "tde_aismc", "pd_plus", "computed_torque", "aismc", "super_twisting")
SCENARIOS = (
    "postcapture", "free_floating", "flight_sensors", "slow_navigation", "flexible_panels",
    "seven_joint", "planar_detumble", "envisat", "reaction_null", "ets_vii", "paper",
    "thrusters_only", "thrusters_and_wheels", "two_arms",
)  # fmt: skip


def drawn(random):
    """An environment's scenario, its other arguments, and the largest action."""
    name = str(random.choice(SCENARIOS))
    given = [f"duration={random.choice([0.05, 0.12, 0.4])}"]
    if name == "two_arms":  # an action is a force on every coordinate
        given.append("chain.law=plain")
    diverges = bool(random.integers(2))
    if diverges:
        start = max(map(abs, load_scenario(name).initial_velocity.values()), default=0.0)
        given.append(f"divergence_speed={start + random.choice([0.15, 0.3, 0.8])}")
    if random.integers(2):
        mass = load_scenario(name).payload.truth.mass
        given.append(f"payload.truth.mass={mass * random.uniform(0.5, 2.0)}")
    coordinates = make_nominal_plant(load_scenario(name)).coordinates
    if random.integers(3) == 0 and not coordinates.undriven:
        joint = random.choice(coordinates.joints)
        fault = f"unit: joints.{joint}, kind: jammed, time: [0.01, 0.04]"
        given.append(f"faults.events.jam={{{fault}}}")
    kind, settings = str(random.choice(["force", "residual", "setpoint"])), {}
    scenario = load_scenario(name, given)
    if name in ("free_floating", "reaction_null"):
        kind = "force" if kind == "setpoint" else kind
    elif name != "planar_detumble":
        settings["law"] = str(random.choice(LAWS))
    settings |= {"action": kind, "samples_per_step": int(random.integers(1, 6))}
    if diverges:
        settings["scale"] = float(random.choice([1.0, 30.0, 1000.0]))
    return scenario, settings, 1.0 if diverges else 0.05


def assert_like_drake(random, scenario, settings, most):
    """Over some episodes with restarts of single copies, and an action that is no number."""
    number = int(random.integers(1, 4))
    compiled, drake = (
        MissionVectorEnv(number, scenario, engine=engine, dtype=np.float64, **settings)
        for engine in ("compiled", "drake")
    )
    seen, expected = (env.reset(seed=7)[0] for env in (compiled, drake))
    np.testing.assert_allclose(seen, expected, rtol=1e-9, atol=1e-9)
    for _ in range(25):
        if random.integers(15) == 0:
            chosen = random.integers(2, size=number) > 0
            chosen[random.integers(number)] = True
            both = [
                env.reset(seed=11, options={"reset_mask": chosen})[0] for env in (compiled, drake)
            ]
            np.testing.assert_allclose(*both, rtol=1e-7, atol=1e-7)
        actions = random.uniform(-most, most, compiled.action_space.shape)
        # How far NaN goes through a law depends on the zeros in its matrices, and it goes through
        # thrusters in a later frame.
        goes_through = settings["action"] == "setpoint" or scenario.actuation.thrusters is not None
        if not goes_through and random.integers(15) == 0:
            actions[random.integers(number), random.integers(actions.shape[1])] = np.nan
        (*found, info), (*expected, own) = (env.step(actions) for env in (compiled, drake))
        np.testing.assert_allclose(found[0], expected[0], rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-7, atol=1e-9)
        np.testing.assert_array_equal(found[2:], expected[2:])
        assert_equal_info(info, own)
    compiled.close()
    drake.close()


def several(random, draws):
    pytest.importorskip("llvmlite", reason="needs llvmlite, an extra")
    for _ in range(draws):
        given = drawn(random)
        assert_like_drake(random, *given)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_compiled_copies_are_those_of_drake(seed):
    several(np.random.default_rng(seed), 1)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"action": "force"}, {"action": "residual", "law": "tdc"}])
def test_two_hands_on_the_target_are_those_of_drake(settings):
    pytest.importorskip("llvmlite", reason="needs llvmlite, an extra")
    scenario = load_scenario("two_arms", ["duration=0.12", "chain.law=plain"])
    settings = {**settings, "samples_per_step": 3}
    assert_like_drake(np.random.default_rng(0), scenario, settings, 0.05)


@pytest.mark.long
def test_many_compiled_copies_are_those_of_drake():
    several(np.random.default_rng(0), 10 * DRAWS)


def test_a_copy_has_the_same_bits_whatever_the_number_of_copies():
    pytest.importorskip("llvmlite", reason="needs llvmlite, an extra")
    settings = {"overrides": ("duration=0.3", "divergence_speed=0.3"), "samples_per_step": 3}
    settings |= {"action": "residual", "scale": 500.0, "engine": "compiled"}
    envs = [MissionVectorEnv(number, "postcapture", **settings) for number in (1, 5, 17)]
    for env in envs:
        env.reset(seed=[4, *range(100, 99 + env.num_envs)])
    random, ends = np.random.default_rng(0), 0
    for _ in range(40):
        actions = random.uniform(-1.0, 1.0, envs[-1].action_space.shape)
        found = [env.step(actions[: env.num_envs]) for env in envs]
        for each in found[1:]:
            for one, other in zip(found[0][:4], each[:4], strict=True):
                np.testing.assert_array_equal(one[0], other[0])
        ends += int(found[0][2][0])
    assert ends > 1


def test_it_says_how_copies_begin():
    env = made(overrides=("duration=1",))
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    zeros = np.zeros(env.action_space.shape)
    for _ in range(2):
        with pytest.raises(FfsmError, match="call reset"):
            env.step(zeros)
        env.reset(seed=1)
        env.step(zeros)
        env.close()
    with pytest.raises(FfsmError, match="num_envs: must be 1 or more, not 0"):
        MissionVectorEnv(0, "postcapture")


def test_a_first_reset_of_some_copies_is_refused():
    pytest.importorskip("llvmlite", reason="needs llvmlite, an extra")
    env = made(overrides=("duration=1",), engine="compiled")
    with pytest.raises(FfsmError, match="reset_mask leaves copies without an episode"):
        env.reset(options={"reset_mask": np.array([True, False, True])})


@pytest.mark.parametrize(
    ("scenario", "law", "reason"),
    [
        ("tumbling_capture", "tdc", "capture.approach"),
        ("postcapture", "adapting_laws:SuperTwisting", "under actions"),
    ],
)
def test_a_mission_that_is_not_compiled_uses_drake_and_says_why(scenario, law, reason):
    pytest.importorskip("llvmlite", reason="needs llvmlite, an extra")
    given = (2, scenario, ("duration=0.05",)) if law != "tdc" else (2, scenario)
    env = MissionVectorEnv(*given, action="residual", law=law)
    assert env.engine.startswith("drake (not covered: ")
    assert reason in env.engine
    with pytest.raises(FfsmError, match=reason):
        MissionVectorEnv(*given, action="residual", law=law, engine="compiled")
