"""Laws that track a frame: exact kinematics, boundedness near singularities, closed loops of
free-floating arms.
"""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.systems.framework import LeafSystem

from ffsm_drake import load_scenario
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability.boundaries import with_gains
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.task_space.tasks import TaskSpace
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.runs.simulate import make_record
from ffsm_drake.show.results import results_of
from ffsm_drake.show.tables import results_table
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.free_floating import FreeFloating, free_floating
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers import complete_gains, controller_setup, make_law
from ffsm_drake.systems.controllers.law import Sample
from ffsm_drake.systems.frame_path import FRAME_SIZE

LAWS = ("resolved_rate", "task_computed_torque", "task_time_delay")
ONE_OF_LAWS = [
    pytest.param(law, marks=[pytest.mark.slow] * (law != "task_time_delay")) for law in LAWS
]
QUIET = ["sensing.velocity_noise=0", "disturbance.amplitude_scale=0"]
ORIGIN = [
    f"{which}_posture.base_{what}=[0, 0, 0]"
    for which in ("initial", "target")
    for what in ("rpy", "position")
]
FREE = ["actuation.driven=[joints]", *ORIGIN]
SERVICER = "servicer::end_effector"


def scenario_of(*overrides, name="seven_joint"):
    return load_scenario(name, [*QUIET, *FREE, *overrides])


def first(scenario, model):
    """The configuration of the initial posture."""
    return configuration(model.coordinates, scenario.initial_posture, key="")


def state_of(scenario, seed=0):
    """A random state near the initial posture, of small velocities."""
    random = np.random.default_rng(seed)
    q = first(scenario, make_nominal_plant(scenario))
    q[4:] += 0.2 * random.normal(size=q.size - 4)
    q[:4] += 0.2 * random.normal(size=4)
    q[:4] /= np.linalg.norm(q[:4])
    return q, 0.1 * random.normal(size=q.size - 1), random


def sample_at(q, v, random):
    """A sample with errors of every kind, and a path of the frame."""
    small = [0.01 * random.normal(size=v.size) for _ in range(5)]
    path = np.concatenate([q[:4], 1.0 + 0.1 * random.normal(size=FRAME_SIZE - 4)])
    return Sample(q, v, q, v + small[0], *small[1:], is_first=False, desired_frame=path)


@pytest.mark.parametrize("driven", ["[joints]", "[base_rotation, joints]", "[all]"])
@pytest.mark.smoke
def test_bias_acceleration_of_a_frame(driven):
    """J' v by differences; J* dv_a/dt + A_0 is the frame's acceleration under forces on the driven
    coordinates.
    """
    scenario = scenario_of(f"actuation.driven={driven}")
    model = make_nominal_plant(scenario)
    (q, v, random), step = state_of(scenario), 1e-5
    stack = free_floating(model, q, scenario.driven)
    moved = [q.copy(), q.copy()]
    for sign, each in zip((1.0, -1.0), moved, strict=True):
        model.plant.SetPositions(model.context, q)
        each += sign * step * model.plant.MapVelocityToQDot(model.context, v)
    after, before = (model.calc_jacobian(each, SERVICER) for each in moved)
    frame_bias = model.calc_bias_acceleration(q, v, SERVICER)
    assert_allclose(frame_bias, (after - before) @ v / (2 * step), atol=1e-8)
    tau = np.zeros(v.size)
    tau[stack.driven] = random.normal(size=stack.driven.size)
    bias, jacobian = model.calc_bias(q, v), model.calc_jacobian(q, SERVICER)
    a = np.linalg.solve(stack.mass_matrix, tau - bias)
    predicted = stack.bias_acceleration(jacobian, frame_bias, bias)
    predicted = predicted + stack.generalized_jacobian(jacobian) @ a[stack.driven]
    assert_allclose(predicted, jacobian @ a + frame_bias, atol=1e-11)
    several = model.calc_bias_acceleration(np.stack([q, q]), np.stack([v, 2 * v]), SERVICER)
    assert_allclose(several, [frame_bias, 4 * frame_bias], atol=1e-12)
    with pytest.raises(ValueError, match="velocity v is not finite"):
        model.calc_bias_acceleration(q, np.full_like(v, np.nan), SERVICER)


@pytest.mark.parametrize("driven", ["[joints]", "[base_rotation, joints]", "[all]"])
@pytest.mark.parametrize("task", ["pose", "position", "attitude"])
def test_computed_torque_gives_the_frame_the_acceleration_it_wants(driven, task):
    frame = f"reference.frame={{task: {task}}}"
    scenario = scenario_of(f"actuation.driven={driven}", "controller=task_computed_torque", frame)
    model = make_nominal_plant(scenario)
    law, (q, v, random) = make_law(make_mission(scenario), model), state_of(scenario)
    sample = sample_at(q, v, random)
    sample = sample._replace(e=np.where(model.coordinates.is_driven, sample.e, 0.0))
    force, memory = law.step(sample, law.initial_state())
    assert not force[~model.coordinates.is_driven].any()
    a = np.linalg.solve(model.calc_mass_matrix(q), force - model.calc_bias(q, v))
    rows = {"pose": slice(0, 6), "position": slice(3, 6), "attitude": slice(0, 3)}[task]
    point = law.task_space.at(sample, damping=law.damping)
    feedback = law.feedback(10.0 * point.e_dot + 25.0 * law.limited(point.e))
    assert (np.linalg.norm(feedback.reshape(-1, 3), axis=1) < 0.5 + 1e-12).all()
    acceleration = model.calc_jacobian(q, SERVICER) @ a + model.calc_bias_acceleration(
        q, v, SERVICER
    )
    assert_allclose(acceleration[rows], sample.desired_frame[13:][rows] + feedback, atol=1e-10)
    base = model.coordinates.driven[:-7]
    wanted = sample.a_d + 10.0 * sample.e_dot + 25.0 * sample.e
    assert_allclose(a[base], wanted[base], atol=1e-10)  # a driven base follows its plan
    sizes = np.linalg.svd(point.jacobian[:, base.size :], compute_uv=False)
    assert memory["smallest_singular_value"] == pytest.approx(sizes[-1])


def test_joint_rates_are_bounded_however_near_a_singularity():
    scenario = scenario_of("controller=resolved_rate")
    setup = controller_setup(make_mission(scenario), make_nominal_plant(scenario))
    space, (q, v, random) = TaskSpace.from_setup(setup), state_of(scenario)
    for bend in (0.0, 1e-9, 1e-3, 0.05, 0.3):  # of the elbow: stretched out
        q[7:] = [0.3, 0.2, 0.1, bend, 0.2, -0.1, 0.4]
        point = space.at(sample_at(q, v, random), damping=0.1)
        at_rest = np.zeros(7)
        for _ in range(20):
            wanted = random.normal(size=6)
            rates = point.served(at_rest, wanted)
            assert np.isfinite(rates).all()
            assert np.linalg.norm(rates) <= 1.09 / 0.1 * np.linalg.norm(wanted)
    assert point.smallest_singular_value > 0.1
    assert_allclose(point.jacobian @ point.served(at_rest, wanted), wanted, atol=1e-12)


def far_away(setup):
    """A reference that holds still, and a frame 5 m away."""
    return Far(setup)


class Far(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        q = first(setup.scenario, setup.nominal)
        pose = setup.nominal.calc_frame_pose(q, SERVICER)
        goal = np.concatenate([pose[:4], pose[4:] + np.array([4.0, 1.0, 3.0]), np.zeros(12)])
        for name, value in (
            ("desired_state", np.concatenate([q, np.zeros(q.size - 1)])),
            ("desired_acceleration", np.zeros(q.size - 1)),
            ("desired_frame", goal),
        ):
            self.DeclareVectorOutputPort(
                name, value.size, lambda context, output, value=value: output.SetFromVector(value)
            )


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, marks=pytest.mark.slow if law == LAWS[0] else pytest.mark.long)
        for law in LAWS
    ],
)
def test_a_goal_out_of_reach(law):
    """The arm stretches out to it and rests, singular: forces and rates stay bounded, and it is
    said.
    """
    scenario = complete_gains(
        scenario_of(f"controller={law}", "duration=25", f"controllers.{law}.k_p_plan=0")
    )
    log = Rollout(scenario, blocks={"reference": far_away}).run()
    assert log.outcome.completed
    rates = log.series["state"][:, 15 + 5 :]
    assert np.abs(rates).max() < 1.0
    assert np.abs(rates[-100:]).max() < 0.01
    assert np.abs(log.generalized_force).max() < 300.0
    assert log.series["smallest_singular_value"].min() < 0.02
    assert log.frame_error[-1, 3:] @ log.frame_error[-1, 3:] > 4.0
    table = results_table([make_record(log, start=0.0)])
    assert "near a dynamic singularity for" in table
    assert "below 0.1 the frame lags its reference" in table


def followed(law, *overrides):
    scenario = scenario_of(f"controller={law}", "reference.duration=8", "duration=10", *overrides)
    return Rollout(scenario).run()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "most"),
    [("resolved_rate", 1e-2), ("task_computed_torque", 2e-3), ("task_time_delay", 1e-5)],
)
def test_the_frame_gets_there_with_the_wrong_payload(law, most):
    """The nominal mass is a fifth too low: joints end elsewhere than planned, the frame does
    not.
    """
    path = "reference.frame={position: [2.2, 0.9, 3.1], frame: 'servicer::end_effector'}"
    log = followed(law, path, "target_posture.joints={}")
    error = log.frame_error
    assert np.array_equal(log.table["frame_tracked"].values, [True] * 6)
    assert np.abs(error).max() < most
    assert np.abs(error[-1]).max() < 1e-4
    assert np.abs(log.error[-1, 6:]).max() > 3e-3
    assert log.tracked.names == tuple(
        f"frame_{what}_{axis}" for what in ("rotation", "position") for axis in "xyz"
    )
    record = make_record(log, start=0.0)
    assert record.metrics["frame"]["final"]["position"] == pytest.approx(
        np.linalg.norm(error[-1, 3:])
    )
    assert record.metrics["itae"] == log.metrics["itae"] < 0.1
    (result,) = results_of([record])
    assert result.status == "settled", result.verdict
    assert "the frame servicer::end_effector ends" in results_table([record])


@pytest.mark.slow
def test_with_the_true_payload_the_frame_follows_but_for_the_hold():
    """What is left is that the force is held over the period: it halves with it. The frame follows
    the plan.
    """
    truth = "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}"
    errors = []
    for period in (0.01, 0.005):
        log = followed(
            "task_computed_torque",
            truth,
            f"sample_time={period}",
            f"simulator_config.max_step_size={period}",
            "duration=4",  # beyond the largest accelerations of the first half
        )
        errors.append(np.abs(log.frame_error).max())
    assert errors[0] < 3e-5
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.05)


def test_the_port_is_there_only_where_it_is_used():
    plain, path = scenario_of(), "reference.frame={position: [2.2, 0.9, 3.1], task: position}"
    short = "reference.duration=1"
    loops = {
        (law, given): make_closed_loop(
            scenario_of(f"controller={law}", short, *([path] if given else []))
        )
        for law in ("tdc", "resolved_rate")
        for given in (True, False)
    }
    for (law, given), loop in loops.items():
        assert loop.tracks_frame == (law == "resolved_rate")
        assert ("desired_frame" in loop.sources) == given
        assert loop.blocks["reference"].HasOutputPort("desired_frame") == given
    loop = loops["resolved_rate", True]
    context = loop.diagram.CreateDefaultContext()
    row = loop.output_port("desired_frame").Eval(
        loop.blocks["reference"].GetMyContextFromRoot(context)
    )
    model = make_nominal_plant(plain)
    pose = model.calc_frame_pose(first(plain, model), SERVICER)
    assert_allclose(row[:7], pose, atol=1e-12)
    assert not row[7:].any()


def test_a_joint_law_is_judged_by_joints_beside_a_frame():
    log = followed(
        "computed_torque",
        "duration=0.1",
        "reference.frame={position: [2.2, 0.9, 3.1], task: position}",
    )
    assert not log.table["frame_tracked"].values.any()
    assert log.frame_error.shape == (11, 6)
    assert log.tracked.groups == ("joints",) * 7
    record = make_record(log, start=0.0)
    assert list(record.metrics["frame"]["final"]) == ["position"]
    assert " mm from its reference (at most " in results_table([record])


@pytest.mark.slow
def test_the_kalman_filter_of_a_frame():
    """It takes its noises through the Jacobian, and smooths: less force than one sample gives, with
    noisy sensors.
    """
    noise = [
        "sensing.velocity_noise=1e-4",
        "sensing.position_noise=1e-5",
        "duration=3",
        "estimator.walk=0.1",
    ]
    one_sample, kalman = (
        followed("task_time_delay", *noise, f"estimator.kind={kind}").generalized_force
        for kind in ("one_sample", "kalman")
    )
    assert np.abs(np.diff(kalman, axis=0)).mean() < 0.5 * np.abs(np.diff(one_sample, axis=0)).mean()


@pytest.mark.parametrize("missing", [0, 7, None])  # number of a coordinate
def test_a_frame_is_new_if_all_coordinates_are(missing):
    """A link that loses readings: its filter corrects the estimate of a frame with whole ones."""
    scenario = scenario_of("controller=task_time_delay", "estimator.kind=kalman")
    nominal = make_nominal_plant(scenario)
    law = make_law(make_mission(scenario), nominal)
    nv, seen = nominal.coordinates.num_velocities, []

    class Watched(type(law.estimator)):
        def step(self, sample, *others):
            seen.append(sample.is_new)
            return super().step(sample, *others)

    gain = law.estimator.gain
    law = dataclasses.replace(law, estimator=Watched(sample_time=0.01, gain=gain))
    q, v, random = state_of(scenario)
    is_new = np.array([True] * nv + [k != missing for k in range(nv)])
    e, e_dot = random.normal(size=(2, v.size))
    sample = Sample(q, v, q, v, v, e, e_dot, 0.0 * v, is_first=True, is_new=is_new)
    law.step(sample, law.initial_state())
    assert seen[0].tolist() == [True] * 6 + [missing is None] * 6


LATE = ("sensing.delay=3", "sensing.position_period={base_position: 5}")


@pytest.mark.slow
@pytest.mark.parametrize("estimator", [("kind=coupled",), ("kind=kalman", *LATE)])
def test_an_estimator_of_the_coordinates_serves_a_frame(estimator):
    """Coordinates together, and late and slow sensors: the frame is that of the estimated state."""
    kind, *late = estimator
    noise = [
        "sensing.velocity_noise=1e-5",
        "sensing.position_noise=1e-6",
        "duration=4",
        "actuation.driven=[all]",
        "controllers.task_time_delay={k_p_rotation: 25, k_p_position: 25, k_d_rotation: 10, "
        "k_d_position: 10}",
        "estimator.walk=0.03",
        *late,
    ]
    log = followed("task_time_delay", *noise, f"estimator.{kind}")
    assert log.ending.status != "diverged"
    assert 1e-9 < np.abs(log.frame_error).max() < 2e-3
    if late:  # the estimate is what makes it work
        assert followed("task_time_delay", *noise).ending.status == "diverged"


def at_zero_momentum(scenario):
    """The scenario kicked by joint rates, held where it starts."""
    model = make_true_plant(scenario)
    q = first(scenario, model)
    stack = FreeFloating(
        mass_matrix=model.calc_mass_matrix(q),
        base_position=q[4:7],
        driven=np.arange(6, model.plant.num_velocities()),
    )
    kick = stack.velocity(np.full(stack.driven.size, 1e-6))
    velocity = dict(zip(model.coordinates.names, kick.tolist(), strict=True))
    return dataclasses.replace(
        scenario, target_posture=scenario.initial_posture, initial_velocity=velocity
    )


@pytest.mark.parametrize(
    ("law", "boundary"),
    [
        ("task_time_delay", 2.78),
        # what is predicted of them: the poles below
        pytest.param("resolved_rate", 9.99, marks=pytest.mark.long),
        pytest.param("task_computed_torque", 19.99, marks=pytest.mark.long),
    ],
)
def test_boundary_of_stability_predicted_and_run(law, boundary):
    """Free floating and held: 1.5 % inside the boundary of the gains a kick dies out, 1.5 % outside
    it grows.
    """
    scenario = complete_gains(
        at_zero_momentum(scenario_of(f"controller={law}", "duration=4", "reference.duration=1"))
    )
    for factor, stable in ((0.985, True), (1.015, False)):
        changed = with_gains(scenario, factor * boundary)
        with Linearizer(changed) as linearizer:
            assert (linearizer.at(0.0).spectral_radius < 1.0) == stable
        log = Rollout(changed).run()
        rate = np.abs(log.series["state"][-50:, 15 + 5 :]).max()
        assert (rate < 1e-7) == stable, rate


@pytest.mark.parametrize("law", LAWS)
def test_poles_of_a_free_floating_frame(law):
    """With the true payload they are those of a frame of unit inertia: of the law's own gains."""
    truth = "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}"
    scenario = scenario_of(f"controller={law}", truth)
    scenario = dataclasses.replace(scenario, target_posture=scenario.initial_posture)
    with Linearizer(scenario) as linearizer:
        poles = linearizer.at(0.0).poles
    exact = 0.9899496
    # e'' held over a period: z of e_{k+1} = e + L e' - L^2/2 u, u = k_d e' + k_p e
    if law != "task_time_delay":
        k_d, k_p = (10.0, 25.0) if law == "task_computed_torque" else (20.0, 40.0)
        step = scenario.sample_time
        held = np.array(
            [[1 - 0.5 * step**2 * k_p, step - 0.5 * step**2 * k_d], [-step * k_p, 1 - step * k_d]]
        )
        exact = np.abs(np.linalg.eigvals(held)).max()
    assert np.abs(poles[0]) == pytest.approx(exact, abs=2e-5)
    assert len(poles) >= 14


@pytest.mark.long
def test_momentum_over_a_minute():
    momentum = "initial_velocity={base_rotation_z: 0.005, base_position_x: 0.002}"
    exact = [
        "simulator_config.integration_scheme=runge_kutta5",
        "simulator_config.max_step_size=0.005",
    ]
    log = followed("task_time_delay", "duration=60", "reference.duration=50", momentum, *exact)
    data = make_record(log, start=0.0).dataset
    for name in ("linear_momentum", "angular_momentum"):
        values = data[name].values
        assert np.abs(values - values[0]).max() < 1e-11 * np.linalg.norm(values[0])
