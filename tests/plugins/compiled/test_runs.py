"""Compiled runs against Drake's."""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from compared_runs import check
from law_lists import joint_laws

from ffsm_drake import FfsmError, load_scenario, simulate_many
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.campaign.cases import with_controller
from ffsm_drake.plugins.compiled import engine
from ffsm_drake.plugins.compiled.noise import noise_of
from ffsm_drake.plugins.compiled.recent import Recent
from ffsm_drake.runs.batches import run_many
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.controllers.laws.pd_plus import PdPlus
from ffsm_drake.systems.sensing.errors import SensorErrors


def varied(given, count):
    masses = (f"payload.truth.mass={90 + 10 * k}" for k in range(count))
    return [
        load_scenario("postcapture", ["duration=0.3", f"random_seed={k}", mass, *given])
        for k, mass in enumerate(masses)
    ]


LAWS = joint_laws("coordinated", "slotine_li", "tvlqr")  # of any mission


@pytest.mark.smoke
def test_runs_are_those_of_drake():
    check(varied([], 3))


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(
            law, marks=pytest.mark.slow if law in ("tdc", "fixed_time") else pytest.mark.long
        )
        for law in LAWS
    ],
)
def test_each_law_has_the_runs_of_drake(law):
    check(varied([f"controller={law}"], 3))


PARTS = {
    "sensing": [
        "sensing.position_noise=0.001", "sensing.velocity_bias=0.001",
        "sensing.position_bias={base_rotation: 0.01}", "sensing.velocity_quantization=0.0001",
        "sensing.velocity_noise=0", "sensing.velocity_bias_walk=0.001",
        "sensing.position_correlated_noise=0.001", "sensing.velocity_noise=0.0001",
    ],
    "actuation": ["actuation.limit=2", "actuation.quantization=0.01"],
    "estimator": ["estimator.kind=kalman", "estimator.kind=one_sample"],
    "simulator": [
        "simulator_config.integration_scheme=explicit_euler",
        "simulator_config.integration_scheme=runge_kutta2", "simulator_config.max_step_size=0.005",
        "sample_time=0.005",
    ],
    "others": [
        "disturbance.frequency_scale=3", "command_filter.low_pass=5", "controllers.tdc.k_d=3",
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    "seed",
    [pytest.param(k, marks=pytest.mark.slow if k < 1 else pytest.mark.long) for k in range(6)],
)
def test_drawn_scenarios_have_the_runs_of_drake(seed):
    """Of each part of the loop one variant, or none."""
    random = np.random.default_rng(seed)
    for _ in range(4):
        given = [str(random.choice([*each, ""])) for each in PARTS.values()]
        law = random.choice(["tdc", "tde_aismc", "computed_torque"])
        scenarios = varied([f"controller={law}", *filter(None, given)], 2)
        check(scenarios)


DRIFTING = [  # along no axis that turns
    "sensing.velocity_bias_walk={joints: 0.001}",
    "sensing.position_correlated_noise={joints: 0.001}",
]


@pytest.mark.parametrize("given", [(), DRIFTING])
@pytest.mark.parametrize(
    "seeds",
    [pytest.param(2, marks=pytest.mark.smoke), pytest.param(1000, marks=pytest.mark.long)],
)
def test_noise_is_that_of_drake(seeds, given):
    """The least and the largest seed, and drawn ones: white noise after what drifts."""
    random = np.random.default_rng(1)
    scenario = load_scenario("postcapture", ["duration=0.3", *given])
    rollout, coordinates = Rollout(scenario), make_nominal_plant(scenario).coordinates
    errors = SensorErrors(scenario.sensing, coordinates, scenario.sample_time)
    drift = errors.drift()
    for seed in (0, 2**31 - 1, *random.integers(2**31, size=seeds).tolist()):
        log = rollout.run(dataclasses.replace(scenario, random_seed=seed))
        size, count = errors.deviation.size, len(log.time)
        drawn = noise_of(seed, count, size=size, drifting=drift.entries.size)
        expected = log.series["state"] + errors.deviation * drawn.white
        x = drift.start * drawn.start
        for k in range(count):
            expected[k, drift.entries] += x
            x = drift.kept * x + drift.added * drawn.drift[k]
        np.testing.assert_array_equal(expected, log.series["measurement"])
    rollout.release()


@pytest.mark.slow
def test_bits_do_not_depend_on_the_others():
    scenarios = varied([], 19)
    together = simulate_many(scenarios, engine="compiled")
    alone = [simulate_many([scenario], engine="compiled")[0] for scenario in scenarios[::6]]
    for one, other in zip(alone, together[::6], strict=True):
        assert one.dataset.identical(other.dataset)


@pytest.mark.parametrize(
    "seed",
    [pytest.param(k, marks=pytest.mark.slow if k < 1 else pytest.mark.long) for k in range(8)],
)
def test_runs_of_a_case_that_share_it_have_the_bits_of_runs_alone(seed):
    """Controllers of a case share plants, noise and reference; one law reads planned tables."""
    random = np.random.default_rng(seed)
    given = [each for part in PARTS.values() for each in random.permutation(part)[:1].tolist()]
    runs = []
    for case in varied([*given, "duration=0.1"], 2):
        for law in random.permutation([*LAWS, "tvlqr"])[:2].tolist():
            runs.append(with_controller(case, law))
    random.shuffle(runs)
    together, apart = dict(run_many([*map(Mission, runs)], engine="compiled")), 0
    for number, scenario in enumerate(runs):
        ((_, alone),) = run_many([Mission(scenario)], engine="compiled")
        assert set(alone.series) == set(together[number].series)
        for name, values in alone.series.items():
            np.testing.assert_array_equal(values, together[number].series[name], err_msg=name)
        apart += alone.engine == "compiled"
    assert apart


def test_runs_are_lost_beyond_their_bounds_of_velocity():
    """Bounds at the largest speed of a run, or just below; the others keep their bits."""
    random = np.random.default_rng(4)
    scenarios = varied(["duration=0.5"], 11)
    logs = [
        log
        for _, log in sorted(
            run_many([*map(Mission, scenarios)], engine="compiled"), key=lambda x: x[0]
        )
    ]
    most = [np.abs(log.series["state"][:, 12:]).max() for log in logs]
    beyond = random.random(len(logs)) < 0.5
    bounds = np.where(beyond, np.nextafter(most, 0.0), most).tolist()
    bounded = [
        dataclasses.replace(scenario, divergence_speed=bound)
        for scenario, bound in zip(scenarios, bounds, strict=True)
    ]
    found = engine.Compiled().run_all([*map(Mission, bounded)], ["state", "desired_state"])
    assert [log is None for log in found] == beyond.tolist()
    for log, other in zip(found, logs, strict=True):
        if log is not None:
            assert set(log.series) == {"state", "desired_state"}
            np.testing.assert_array_equal(log.series["state"], other.series["state"])


@pytest.mark.parametrize(
    "given",
    [
        "blocks.forces={drag: {system: 'tests_drag:none'}}",
        "simulator_config.use_error_control=true",
    ],
)
def test_a_run_with_more_does_not_share_the_code_of_one_without(given):
    plain = load_scenario("postcapture", ["duration=0.1"])
    more = load_scenario("postcapture", ["duration=0.1", given])
    one, other = simulate_many([plain, more], engine="compiled", keep_errors=True)
    assert one.engine == "compiled"
    assert isinstance(other, FfsmError) or other.engine.startswith("drake (not covered: ")


GAIN = [1.0]


def scaled(setup):
    """A law of the package, with gains that change."""
    law = PdPlus.from_setup(setup)
    return dataclasses.replace(law, k_p=GAIN[0] * law.k_p)


def test_a_law_of_a_users_function_is_made_for_each_run():
    scenario = load_scenario("postcapture", ["duration=0.05", "controller=test_runs:scaled"])
    for factor in (1.0, 0.5):
        GAIN[0] = factor
        check([scenario])


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_codes(monkeypatch):
    """More codes than are kept: those compiled again need no comparison, which reads all signals
    of a log.
    """
    monkeypatch.setattr(engine, "_kernels", Recent(2))
    random = np.random.default_rng(0)
    scenarios = [
        load_scenario("postcapture", ["duration=0.05", f"controller={law}", f"random_seed={k}"])
        for k, law in enumerate(random.permutation(LAWS)[:4].tolist())
    ]
    missions = [*map(Mission, scenarios)]
    for _ in range(3):
        for _, log in run_many(missions, engine="compiled", signals=("state",)):
            assert log.engine == "compiled"
    for _ in range(3):
        assert all(log.engine == "compiled" for _, log in run_many(missions, engine="compiled"))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("amplified", [True, False])
def test_a_run_that_amplifies_rounding_judges_its_code(seed, amplified, monkeypatch):
    """Next to its stability limit a loop amplifies rounding; other differences refuse the code."""
    sample_time = np.random.default_rng(seed).uniform(0.005, 0.006)  # code of its own
    time = f"sample_time={sample_time + 1e-4 * amplified:.6f}"
    scenario = load_scenario("postcapture", ["duration=0.1", time])
    monkeypatch.setattr(engine, "LARGEST_DIFFERENCE", 1e-15 if amplified else -1.0)
    monkeypatch.setattr(engine, "_OF_LAST_BITS", 1e30 if amplified else 0.0)
    ((_, log),) = run_many([Mission(scenario)], engine="compiled")
    assert log.engine.startswith("compiled" if amplified else "drake (not covered: ")


def test_results_depend_on_no_other_run():
    """A group begins with runs that diverge: the first that completes judges the code."""
    loud = "sensing.velocity_noise=1"
    some = [("random_seed=3",), (loud,), (loud, "random_seed=2"), ("random_seed=5",)]
    scenarios = [load_scenario("postcapture", ["duration=0.2", *each]) for each in some]
    orders = itertools.permutations(range(4))
    for order in [*orders][::5]:
        forget()
        records = simulate_many([scenarios[k] for k in order], engine="compiled")
        engines = {k: record.engine for k, record in zip(order, records, strict=True)}
        assert engines[0] == engines[3] == "compiled"
        assert engines[1].startswith("drake")
        assert engines[2].startswith("drake")


def forget():
    """As a new process."""
    engine._kernels = Recent(16)
    engine._judged.clear()


def test_a_signal_without_a_value_is_compared():
    """Gaps in both logs agree; a gap in one log does not."""
    gap, half, whole = np.full(3, np.nan), np.array([1.0, np.nan]), np.array([1.0, 2.0])
    one = SimpleNamespace(series={"gap": gap, "half": half, "other": half})
    other = SimpleNamespace(series={"gap": gap, "half": 2.0 * half, "other": whole})
    found = engine._differences(one, other)
    assert (found["gap"], found["half"]) == (0.0, 0.5)
    assert not found["other"] <= 1.0
