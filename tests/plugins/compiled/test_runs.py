"""Compiled runs against Drake's, and laws that cannot be compiled."""

import dataclasses
import itertools
import sys
import time
from typing import ClassVar

import numpy as np
import pytest

from ffsm_drake import ControlLaw, FfsmError, gain, load_scenario, simulate, simulate_many
from ffsm_drake.plugins.compiled.noise import noise_of
from ffsm_drake.plugins.compiled.parameters import parameters_of
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.systems.sensing import SensorErrors

SAME = {"position": 1e-10, "velocity": 1e-10, "error": 1e-10}  # m, rad, and per second
OTHERS = 1e-7  # share of the largest value


def check(scenarios):
    """Equal to Drake's runs but for rounding. Returns the records."""
    found = simulate_many(scenarios, engine="compiled")
    for record, other in zip(found, simulate_many(scenarios), strict=True):
        assert record.outcome == other.outcome
        completed = other.outcome.status == "completed"
        assert record.engine == ("compiled" if completed else "drake (the run fails or diverges)")
        assert set(record.dataset.variables) == set(other.dataset.variables)
        for name, values in other.dataset.data_vars.items():
            if values.dtype == float:
                bound = SAME.get(name, OTHERS * max(1.0, float(np.abs(values).max())))
                difference = np.abs(record.dataset[name].values - values.values).max()
                assert difference < bound, name
    return found


def varied(given, count):
    masses = (f"payload.truth.mass={90 + 10 * k}" for k in range(count))
    return [
        load_scenario("postcapture", ["duration=0.3", f"random_seed={k}", mass, *given])
        for k, mass in enumerate(masses)
    ]


LAWS = (
    "tdc", "asmc", "aismc", "tde_aismc", "computed_torque", "pd_plus", "fixed_time",
    "super_twisting", "terminal_sliding_mode", "torque_against_momentum",
)  # fmt: skip


@pytest.mark.smoke
def test_runs_are_those_of_drake():
    check(varied([], 3))


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
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
    [pytest.param(k, marks=pytest.mark.slow if k < 2 else pytest.mark.long) for k in range(6)],
)
def test_drawn_scenarios_have_the_runs_of_drake(seed):
    """Of each part of the loop one variant, or none."""
    random = np.random.default_rng(seed)
    for _ in range(4):
        given = [str(random.choice([*each, ""])) for each in PARTS.values()]
        law = random.choice(["tdc", "tde_aismc", "computed_torque"])
        scenarios = varied([f"controller={law}", *filter(None, given)], 2)
        check(scenarios)


@pytest.mark.smoke
@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1])
def test_noise_is_that_of_drake(seed):
    scenario = load_scenario("postcapture", ["duration=0.3", f"random_seed={seed}"])
    log = Rollout(scenario).run(scenario)
    errors = SensorErrors(scenario.sensing, log.coordinates, scenario.sample_time)
    drawn = noise_of(seed, len(log.time), size=errors.deviation.size, drifting=0).white
    assert (log.series["state"] + errors.deviation * drawn == log.series["measurement"]).all()


@pytest.mark.slow
def test_bits_do_not_depend_on_the_others():
    scenarios = varied([], 19)
    together = simulate_many(scenarios, engine="compiled")
    alone = [simulate_many([scenario], engine="compiled")[0] for scenario in scenarios[::6]]
    for one, other in zip(alone, together[::6], strict=True):
        assert one.dataset.identical(other.dataset)


@pytest.mark.slow
def test_a_run_that_diverges_is_repeated_with_drake():
    scenarios = [
        load_scenario("postcapture", ["duration=0.3", f"divergence_speed={bound}"])
        for bound in (10, 1e-4)
    ]
    fine, diverged = simulate_many(scenarios, engine="compiled")
    assert fine.engine == "compiled"
    assert diverged.outcome.status == "diverged"
    assert diverged.engine == "drake (the run fails or diverges)"


@pytest.mark.slow
def test_code_is_compared_with_the_first_run_that_completes():
    scenarios = [
        load_scenario("postcapture", ["duration=0.2", f"divergence_speed={bound}"])
        for bound in (1e-4, 2e-4, 10, 11)
    ]
    found = simulate_many(scenarios, engine="compiled")
    names = ["drake (the run fails or diverges)"] * 2 + ["compiled"] * 2
    assert [record.engine for record in found] == names


@pytest.mark.parametrize(
    "given",
    [
        "environment.solar_pressure.area=10",
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


def test_it_says_what_is_not_covered():
    scenario = load_scenario("thrusters_and_wheels", ["duration=0.1"])
    with pytest.raises(NotCovered, match=r"actuation\.thrusters, actuation.wheels"):
        simulate(scenario, engine="compiled")
    others = [dataclasses.replace(scenario, random_seed=seed) for seed in range(2)]
    given = [*others, load_scenario("postcapture", ["duration=0.1"])]
    *left, compiled = simulate_many(given, engine="compiled")
    assert compiled.engine == "compiled"
    for record, other in zip(left, simulate_many(others), strict=True):
        assert record.engine.startswith("drake (not covered: actuation.thrusters")
        assert record.dataset.identical(other.dataset)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pd(ControlLaw):
    """An honest law; the ones below each break the contract."""

    k_p: np.ndarray = gain(20.0)
    k_d: np.ndarray = gain(60.0)

    def step(self, sample, state):
        return self.force(sample), state

    def force(self, sample):
        return self.k_p * sample.e + self.k_d * sample.e_dot


class Counts(Pd):
    calls: ClassVar = itertools.count()

    def force(self, sample):
        return super().force(sample) + 1e-3 * next(self.calls)


class Draws(Pd):
    def force(self, sample):
        return super().force(sample) + np.random.default_rng().normal(size=sample.e.size)


class Branches(Pd):
    def force(self, sample):
        return super().force(sample) * (0.5 if np.abs(sample.e).max() > 0.1 else 1.0)


class Caches(Pd):
    kept: ClassVar = {}

    def force(self, sample):
        before = self.kept.get("e", sample.e)
        self.kept["e"] = sample.e.copy()
        return super().force(sample) + 5.0 * (sample.e - before)


class Writes(Pd):
    def force(self, sample):
        sample.v[:] = 0.0
        return super().force(sample)


class Clock(Pd):
    def force(self, sample):
        return super().force(sample) + time.perf_counter() % 1.0


class Solves(Pd):
    """Without exchange of rows, the elimination divides by zero."""

    def force(self, sample):
        n = sample.e.size
        swap = np.eye(n)[::-1] + 0.0 * sample.e[:, None]
        return np.linalg.solve(swap + 1e-18 * np.diag(sample.e), super().force(sample))


class Shape(Pd):
    def force(self, sample):
        return super().force(sample)[:-1]


class Names(Pd):
    def step(self, sample, state):
        return self.force(sample), {"more": sample.e}


HOSTILE = (Counts, Draws, Branches, Caches, Writes, Clock, Solves, Shape, Names)


def runs_of(law, count, monkeypatch):
    module = sys.modules[__name__]
    monkeypatch.setitem(sys.modules, "hostile_laws", module)
    scenarios = [
        load_scenario(
            "postcapture",
            ["duration=0.2", f"random_seed={k}", f"controller=hostile_laws:{law.__name__}"],
        )
        for k in range(count)
    ]
    return simulate_many(scenarios, engine="compiled", keep_errors=True)


def test_a_law_of_a_user_joins_by_itself(monkeypatch):
    found = runs_of(Pd, 2, monkeypatch)
    assert {record.engine for record in found} == {"compiled"}


@pytest.mark.slow
@pytest.mark.parametrize("law", HOSTILE, ids=lambda law: law.__name__)
def test_laws_that_break_the_contract_are_not_compiled(law, monkeypatch):
    for record in runs_of(law, 2, monkeypatch):
        if isinstance(record, Exception):  # as with Drake
            assert law in (Caches, Writes, Shape, Names), record
        else:
            assert record.engine.startswith("drake ("), record.engine


@pytest.mark.parametrize("field", [[1.0], {"a": 1.0}, {1.0}, object(), len])
def test_fields_of_unknown_kinds_are_refused(field):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Law(Pd):
        other: object = None

    with pytest.raises(NotCovered, match="field other"):
        parameters_of(Law(k_p=np.ones(3), k_d=np.ones(3), other=field))
