"""Several runs in one simulation: each has the bits that it has alone."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import ControlLaw, load_scenario, simulate, simulate_many
from ffsm_drake.loop.batch import batch_key
from ffsm_drake.runs.batch import batches, run_together
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.systems.controllers.several import CannotShare, share_law

LAB = '''
import numpy as np
from pydrake.systems.framework import LeafSystem

class Friction(LeafSystem):
    """Viscous, on all coordinates; with an event of its own where the settings say so."""

    def __init__(self, setup):
        super().__init__()
        nv = len(setup.coordinates.names)
        self.state = self.DeclareVectorInputPort("state", 2 * nv + 1)
        self.DeclareVectorOutputPort("generalized_force", nv, self.calc)
        self.rate, self.nv = 0.1 + 1e-3 * setup.scenario.random_seed, nv
        if "period" in setup.settings:
            self.DeclarePeriodicPublishEvent(setup.settings["period"], 0.0, lambda context: None)

    def calc(self, context, output):
        output.SetFromVector(-self.rate * self.state.Eval(context)[-self.nv:])
'''


def alone(scenario):
    rollout = Rollout(scenario)
    try:
        return rollout.run()
    finally:
        rollout.release()


def assert_same_bits(log, scenario):
    other = alone(scenario)
    assert log.outcome == other.outcome
    assert log.scenario is scenario
    assert np.array_equal(log.time, other.time)
    assert set(log.series) == set(other.series)
    for name, values in log.series.items():
        assert values.tobytes() == other.series[name].tobytes(), name


def scenarios(name, common, each):
    """One scenario for each of ``each``, a list of overrides, with a seed of its own."""
    return [
        load_scenario(name, ["duration=0.5", *common, f"random_seed={seed}", *own]) for seed, own in enumerate(each)
    ]


PAYLOADS = [["payload.nominal.mass=70"], ["payload.nominal.mass=95", "payload.truth.mass=110"], []]


@pytest.mark.parametrize(
    ("name", "common", "each"),
    [
        *(("postcapture", [f"controller={law}"], PAYLOADS) for law in ("tde_aismc", "aismc", "asmc", "tdc")),
        *(("postcapture", [f"controller={law}"], PAYLOADS) for law in ("computed_torque", "pd_plus")),
        ("flight_sensors", [], [["sensing.velocity_noise=1e-6"], ["sensing.velocity_noise=2e-6"]]),
        ("flight_sensors", ["estimator.kind=coupled"], [["payload.nominal.mass=70"], ["sensing.velocity_noise=2e-6"]]),
        ("flight_sensors", ["sensing.delay=2", "actuation.delay=1"], [[], ["disturbance.amplitude_scale=2"]]),
        ("slow_navigation", ["duration=1.5"], [[], []]),
        ("seven_joint", [], [[], ["target_posture.base_position=[0.1, 0, 0]"]]),
        ("postcapture", ["controller=tdc"], [["controllers.tdc.k_d=90"], ["controllers.tdc.k_p=80"], []]),
        ("postcapture", [], [["controllers.tde_aismc.epsilon=1e-4"], ["controllers.tde_aismc.epsilon=2e-4"]]),
        ("postcapture", [], [["duration=0.3"], ["duration=0.01"], []]),
        ("postcapture", ["simulator_config.max_step_size=0.005"], [[], []]),
    ],
)
def test_a_run_has_the_bits_that_it_has_alone(name, common, each):
    several = scenarios(name, common, each)
    for log, scenario in zip(run_together(several), several, strict=True):
        assert log is not None
        assert_same_bits(log, scenario)


def test_a_run_that_diverges_leaves_the_others_alone():
    """Its own result is that of a run alone; the others go on, to the bit."""
    common = ["controller=asmc", "duration=1.5"]
    several = scenarios("postcapture", common, [[], ["payload.nominal.mass=190"], ["divergence_speed=1e-4"], []])
    logs = run_together(several)
    assert [log is None for log in logs] == [False, True, True, False]
    for k in (0, 3):
        assert_same_bits(logs[k], several[k])
    records = simulate_many(several)
    assert [record.outcome.status for record in records] == ["completed", "diverged", "diverged", "completed"]
    for record, scenario in zip(records, several, strict=True):
        assert record.dataset.identical(simulate(scenario, check_stability=False).dataset)


def test_it_does_not_matter_who_runs_along():
    several = scenarios("postcapture", [], [*PAYLOADS, []])
    for group in ([0, 1], [3, 0], [2, 1, 0]):
        for log, k in zip(run_together([several[k] for k in group]), group, strict=True):
            assert_same_bits(log, several[k])


@pytest.mark.parametrize(("settings", "together"), [("{}", True), ("{period: 0.003}", False)])
def test_a_users_block_runs_along_unless_its_events_divide_the_steps(tmp_path, settings, together):
    (tmp_path / "lab_of_batches.py").write_text(LAB)
    block = f"blocks.forces={{friction: {{system: 'lab_of_batches:Friction', settings: {settings}}}}}"
    several = scenarios("postcapture", [f"python_path=[{tmp_path}]", block], [[], []])
    logs = run_together(several)
    assert [log is not None for log in logs] == [together] * 2
    if together:
        for log, scenario in zip(logs, several, strict=True):
            assert_same_bits(log, scenario)


@pytest.mark.parametrize(
    "override",
    ["simulator_config={integration_scheme: runge_kutta3, use_error_control: true}",
     "simulator_config.integration_scheme=implicit_euler"],
)  # fmt: skip
def test_steps_that_depend_on_all_of_the_state_are_not_shared(override):
    (scenario,) = scenarios("postcapture", [override], [[]])
    assert batch_key(scenario) is None
    assert batches([scenario] * 3, 8) == [[0], [1], [2]]


def test_batches_keep_to_what_is_alike_and_to_their_size():
    tdc, asmc = (load_scenario("postcapture", [f"controller={name}"]) for name in ("tdc", "asmc"))
    assert batches([tdc, asmc, tdc, tdc, asmc], 2) == [[0, 2], [3], [1, 4]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mixing(ControlLaw):
    """Its force follows the largest error of all runs."""

    def step(self, sample, state):
        return sample.e * np.abs(sample.e).max(), state


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneRunOnly(ControlLaw):
    """Takes one run's vector for a matrix's diagonal."""

    def step(self, sample, state):
        return np.diag(sample.e) @ sample.e_dot, state


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sizes(ControlLaw):
    """Takes vectors alone."""

    def step(self, sample, state):
        (size,) = sample.e.shape
        return np.zeros(size), state


@dataclasses.dataclass(frozen=True, kw_only=True)
class Named(ControlLaw):
    """Differs in something that cannot be stacked."""

    label: str

    def step(self, sample, state):
        return sample.e, state


@pytest.mark.parametrize(
    ("laws", "reason"),
    [
        ([Mixing(), Mixing()], "mixes its runs up"),
        ([OneRunOnly(), OneRunOnly()], "mixes its runs up"),
        ([Sizes(), Sizes()], "does not take several runs: ValueError"),
        ([Named(label="a"), Named(label="b")], "law.label differs"),
        ([Mixing(), Named(label="a")], "not of one kind"),
    ],
)
def test_laws_that_do_not_keep_to_themselves_are_not_shared(laws, reason):
    coordinates = Rollout(load_scenario("postcapture", ["duration=0.01"])).loop.coordinates
    with pytest.raises(CannotShare, match=reason):
        share_law(laws, coordinates)
