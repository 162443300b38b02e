"""The supervisor: modes, rate damping, a plan anew, and a loop that it leaves alone."""

import functools

import numpy as np
import pytest
from c_code import needs_llvm
from entry_points import needs
from pydrake.systems.framework import LeafSystem

from ffsm_drake import ScenarioError, load_scenario, simulate
from ffsm_drake.plugins.actuators.base import BaseActuators
from ffsm_drake.plugins.capture.modes import Cause, Mode
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.free_floating import driven_model, free_floating
from ffsm_drake.systems.parts.metrics import nested
from ffsm_drake.systems.parts.placed import figures_of
from ffsm_drake.systems.parts.record import recorded

BEYOND = (  # a target that spins faster than the limits let the law stop it at once
    "capture.approach=null",
    "capture.rate=[0.2, 0.17, 0.22]",
    "controller=tde_aismc",
    "duration=4",
)


def changes(log):
    """Begin and mode of each mode of a run."""
    modes = log.series["mode"].ravel()
    at = np.flatnonzero(np.diff(modes, prepend=-1))
    return [(float(log.time[k]), Mode(int(modes[k]))) for k in at]


@pytest.fixture(scope="module")
def damped():
    return make_rollout(load_scenario("tumbling_capture", [*BEYOND, "supervisor={}"])).run()


def test_what_has_nothing_to_do_changes_no_bit():
    scenario = load_scenario("flight_sensors", ["duration=1"])
    alone = make_rollout(scenario).run()
    watched = make_rollout(scenario.replace(supervisor={})).run()
    for name, values in alone.series.items():
        assert np.array_equal(values, watched.series[name]), name


def test_stages_of_the_integrator_do_not_ask_the_actuators_again(monkeypatch):
    scenario = load_scenario("thrusters_and_wheels", ["duration=0.2", "supervisor={}"])
    calls, step = [], BaseActuators.step

    def counted(self, *args):
        calls.append(1)
        return step(self, *args)

    monkeypatch.setattr(BaseActuators, "step", counted)
    rollout = make_rollout(scenario)
    log = rollout.run()
    rollout.release()
    assert 0 < len(calls) <= log.time.size + 1


@pytest.mark.slow
def test_saturation_is_damped_and_planned_anew(damped):
    limit = damped.coordinates.vector(damped.scenario.actuation.limit, key="limit")
    force = np.abs(damped.series["generalized_force"])
    over = (force > limit * (1.0 + 1e-9)).any(axis=1)
    (_, first), (begin, second), (anew, third) = changes(damped)
    assert (first, second, third) == (Mode.STOP, Mode.RATE_DAMPING, Mode.STOP)
    assert damped.series["mode_cause"].max() == Cause.SATURATED
    # as the counter of saturated time says, to the sample
    counter, before = 0, over[damped.time < begin - 1e-9]
    for is_over in before:
        assert counter <= 50
        counter = max(0, counter + (1 if is_over else -1))
    assert counter == 51
    assert not over[damped.series["mode"].ravel() == Mode.RATE_DAMPING].any()
    assert np.abs(damped.tracked.error[damped.time > anew + 0.5]).max() < 1e-2


def test_damping_lowers_the_energy_at_every_sample(damped):
    modes, model = damped.series["mode"].ravel(), make_true_plant(damped.scenario)
    states = damped.series["state"][modes == Mode.RATE_DAMPING]
    nq = len(damped.coordinates.position_names)
    q, v = states[:, :nq], states[:, nq:]
    energy = np.einsum("ni,nij,nj->n", v, model.calc_mass_matrix(q), v) / 2.0
    assert energy.size > 50
    assert (np.diff(energy[1:]) < 0.0).all()
    nominal = make_nominal_plant(damped.scenario).calc_mass_matrix(q[-1])
    ratio = np.linalg.eigvals(np.linalg.solve(model.calc_mass_matrix(q[-1]), nominal)).real.max()
    assert damped.scenario.supervisor.damping * damped.scenario.sample_time * ratio < 2.0


def test_the_new_plan_starts_where_the_spacecraft_is(damped):
    anew = changes(damped)[2][0]
    k = int(np.flatnonzero(np.isclose(damped.time, anew))[0])
    measured = damped.series["measurement"][k]
    desired = damped.series["desired_state"][k + 1]
    assert np.abs(desired - measured).max() < 2e-3
    assert damped.series["desired_state"].shape == damped.series["state"].shape


def test_the_report_names_the_events(damped):
    placed = damped.parts["supervisor"]
    record = recorded(placed, list(figures_of(placed, damped)))
    figures = nested(record.figures)["supervisor"]
    assert figures["dampings"] == 1
    assert list(figures["events"]) == ["1 stop", "2 rate damping", "3 stop"]
    assert record.sentence.startswith("Supervisor: stop from 0 s, rate damping from 0.56 s, stop")


class Asking(LeafSystem):
    """A force of nothing that asks for an abort from half a second on, or another time."""

    def __init__(self, setup, begin=0.5):
        super().__init__()
        size = len(setup.coordinates.names)
        zeros = np.zeros(size)
        self.DeclareVectorOutputPort(
            "generalized_force", size, lambda context, output: output.SetFromVector(zeros)
        )
        self.DeclareVectorOutputPort(
            "abort_request",
            1,
            lambda context, output: output.SetAtIndex(0, float(context.get_time() > begin - 0.005)),
            {self.time_ticket()},
        )


@pytest.mark.long
def test_a_block_asks_during_the_approach_and_the_servicer_retreats():
    scenario = load_scenario("tumbling_capture", ["supervisor={}", "duration=21"])
    log = make_rollout(scenario, blocks={"forces.asking": Asking}).run()
    assert [mode for _, mode in changes(log)] == [Mode.APPROACH, Mode.RETREAT]
    assert changes(log)[1][0] == pytest.approx(0.5)
    assert log.series["mode_cause"].max() == Cause.REQUEST
    assert log.outcome.status == "missed"
    assert "abandoned the approach at t = 0.5 s" in log.outcome.message
    start = log.series["state"][0]
    assert np.abs(log.series["state"][-1] - start)[7:12].max() < 1e-3  # the joints are back


@pytest.mark.long
def test_while_the_gripper_closes_it_waits():
    given = ["supervisor={}", "capture.closing={}", "duration=21"]
    scenario = load_scenario("tumbling_capture", given)
    asking = functools.partial(Asking, begin=19.5)
    log = make_rollout(scenario, blocks={"forces.asking": asking}).run()
    (_, first), (begin, second) = changes(log)[:2]
    assert (first, second) == (Mode.APPROACH, Mode.RATE_DAMPING)
    assert begin == pytest.approx(20.0)  # at the grasp
    assert log.outcome.completed


def test_an_empty_gripper_retreats_even_where_no_plan_keeps_within_its_share():
    given = ["supervisor={plan_share: 1e-4}", "duration=21", "capture.approach.duration=2"]
    log = make_rollout(
        load_scenario("tumbling_capture", given), blocks={"forces.asking": Asking}
    ).run()
    assert [mode for _, mode in changes(log)] == [Mode.APPROACH, Mode.RETREAT]


def test_what_it_cannot_damp_is_refused():
    with pytest.raises(ScenarioError, match=r"supervisor\.damping"):
        load_scenario("flight_sensors", ["supervisor={damping: 60}"])


def test_it_needs_limits():
    with pytest.raises(ScenarioError, match="no force has a limit"):
        make_rollout(load_scenario("postcapture", ["supervisor={}", "actuation={}"]))


@pytest.fixture(scope="module", params=[["joints"], ["base_rotation", "joints"]], ids=len)
def undriven(request):
    """A stop beyond the limits, without a force on the position of the base, or on its attitude."""
    given = {
        "actuation": {"driven": request.param, "limit": dict.fromkeys(request.param, 1.5)},
        "reference": {"duration": 3.0, "base_rotation": "eigenaxis", "goal": "stop"},
        "capture": {"rate": [0.1, 0.08, 0.12], "servicer": "rest"},
        "supervisor": {"saturated_time": 0.05},
        "disturbance": {"amplitude_scale": 0.0},
        "duration": 10.0,
    }
    return make_rollout(load_scenario("postcapture", [given])).run()


def test_driven_rates_are_damped_and_planned_anew(undriven):
    """Their part of the energy falls at every sample, and no force acts elsewhere."""
    assert [mode for _, mode in changes(undriven)][:3] == [
        Mode.STOP, Mode.RATE_DAMPING, Mode.STOP
    ]  # fmt: skip
    driven = undriven.coordinates.driven
    modes, nq = undriven.series["mode"].ravel(), len(undriven.coordinates.position_names)
    states = undriven.series["state"][modes == Mode.RATE_DAMPING]
    q, v = states[:, :nq], states[:, nq:][:, driven]
    reduced = driven_model(make_true_plant(undriven.scenario)).calc_mass_matrix(q)
    energy = np.einsum("ni,nij,nj->n", v, reduced[:, driven[:, None], driven], v) / 2.0
    assert energy.size > 50
    assert energy[-1] < 0.01 * energy[0]
    assert (np.diff(energy[1:]) < 1e-6 * energy[0]).all()
    assert not np.delete(undriven.series["generalized_force"], driven, axis=1).any()


def test_a_new_plan_keeps_the_momentum(undriven):
    """The nominal one of the measured state, in which its rates come to rest."""
    anew = changes(undriven)[2][0]
    k = int(np.flatnonzero(np.isclose(undriven.time, anew))[0])
    nq, model = len(undriven.coordinates.position_names), make_nominal_plant(undriven.scenario)
    desired = undriven.series["desired_state"][k + 1 :]
    assert np.abs(desired[0] - undriven.series["measurement"][k]).max() < 2e-3
    momentum = [
        free_floating(model, row[:nq], ["joints"]).momentum(row[nq:]) for row in desired[::50]
    ]
    free = slice(3, 6) if undriven.coordinates.is_driven[0] else slice(6)
    momentum = np.array(momentum)[:, free]
    assert np.abs(momentum).max() > 1e-3
    assert momentum == pytest.approx(np.tile(momentum[0], (len(momentum), 1)), abs=1e-9)
    driven = undriven.coordinates.driven
    assert np.abs(desired[-1, nq:][driven]).max() < 1e-9


@needs("compiled")
@needs_llvm
def test_the_compiled_run_of_undriven_coordinates_is_that_of_drake(undriven):
    pytest.importorskip("ffsm_drake.plugins.compiled")
    record = simulate(undriven.scenario, engine="compiled", check_stability=False)
    found = record.dataset["position"].values
    assert found == pytest.approx(undriven.series["state"][:, : found.shape[1]], abs=1e-9)
