"""The closed chain as mechanics: against Pinocchio and MuJoCo, by its gap and by momentum."""

import dataclasses

import numpy as np
import pytest
import two_arms_oracle as oracle
from c_code import needs_llvm
from entry_points import needs
from numpy.testing import assert_allclose

from ffsm_drake import (
    ControlLaw,
    Scenario,
    ScenarioError,
    load_scenario,
    make_closed_loop,
    simulate,
)
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.spacecraft.craft import make_true_plant
from ffsm_drake.systems.start import state_at_start

NQ, NV = 19, 18
FREE = ["sensing.velocity_noise=0", "disturbance.amplitude_scale=0", "chain.law=plain"]


class Push(ControlLaw):
    """Constant joint torques."""

    def step(self, sample, state):
        return np.r_[np.zeros(6), TORQUES], state


class Rock(ControlLaw):
    """Joint torques back and forth, without end."""

    def initial_state(self):
        return {"samples": np.zeros(1)}

    def step(self, sample, state):
        force = 0.05 * np.cos(0.01 * state["samples"] * np.arange(1, 13))
        return np.r_[np.zeros(6), force], {"samples": state["samples"] + 1.0}


TORQUES = 0.3 * np.random.default_rng(1).uniform(-1, 1, 12)


def scenario(*overrides: str) -> Scenario:
    return load_scenario("two_arms", [*FREE, *overrides])


def consistent_states(count: int):
    """Closed configurations, velocities with A v = 0 and forces, drawn."""
    given = scenario()
    model = make_true_plant(given)
    chain, generator = ClosedChain(model, given, true=True), np.random.default_rng(0)
    start = state_at_start(make_mission(given), model)[:NQ]
    for _ in range(count):
        q = start.copy()
        q[:4] = generator.normal(size=4)
        q[:4] /= np.linalg.norm(q[:4])
        q[4:] += 0.08 * generator.normal(size=NQ - 4)
        q = chain.closed(q)
        jacobian = chain.jacobian(q)
        v = 0.3 * generator.normal(size=NV)
        v -= np.linalg.pinv(jacobian) @ jacobian @ v
        yield q, v, generator.normal(size=NV)


def constrained_acceleration(loop: ClosedLoop, state: np.ndarray, force: np.ndarray) -> np.ndarray:
    """dv/dt of the plant with the contacts' force, all other forces being ``force``."""
    model = loop.mission.craft.flexible(loop.grip)
    contact = loop.blocks["forces.contacts"]
    context = contact.CreateDefaultContext()
    contact.GetInputPort("state").FixValue(context, state)
    contact.GetInputPort("other_force").FixValue(context, force)
    acts = contact.GetOutputPort("generalized_force").Eval(context)
    q, v = np.split(state, [NQ])
    return np.linalg.solve(model.calc_mass_matrix(q), force + acts - model.calc_bias(q, v))


@pytest.mark.smoke
def test_the_gap_does_not_accelerate() -> None:
    """A dv/dt + dA/dt v = 0 with closed loops, by finite differences of A v."""
    given = scenario("contacts.right.stabilization=0")
    loop, model = make_closed_loop(given), make_true_plant(given)
    chain = ClosedChain(model, given, true=True)
    for q, v, force in consistent_states(5):
        a = constrained_acceleration(loop, np.r_[q, v], force)

        def rate(time: float, q=q, v=v, a=a) -> np.ndarray:
            model.plant.SetPositions(model.context, q)
            moved = q + time * model.plant.MapVelocityToQDot(model.context, v + 0.5 * time * a)
            return chain.jacobian(moved) @ (v + time * a)

        assert_allclose((rate(1e-5) - rate(-1e-5)) / 2e-5, 0.0, atol=1e-7)


def test_acceleration_agrees_with_pinocchio() -> None:
    pin = pytest.importorskip("pinocchio", reason="needs the extra 'oracles'")
    theirs = oracle.pinocchio_acceleration(pin)
    loop = make_closed_loop(scenario("contacts.right.stabilization=0"))  # of a gap but rounding
    for q, v, force in consistent_states(30):
        ours = constrained_acceleration(loop, np.r_[q, v], force)
        expected = theirs(q, v, force)
        assert_allclose(ours, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max()))


def test_a_run_agrees_with_mujoco() -> None:
    """4 s at 10 ms, against a stiff weld at 1 ms."""
    given = scenario("duration=4")
    record = simulate(given, blocks={"controller": Push}, check_stability=False)
    state = np.c_[record.dataset["position"].values, record.dataset["velocity"].values]
    theirs = oracle.mujoco_run(state[0, :NQ], state[0, NQ:], TORQUES, time=4.0, step=1e-3)
    assert np.abs(state[-1, 7:NQ] - state[0, 7:NQ]).max() > 0.1
    assert_allclose(state[-1], theirs, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_momentum_and_gap_over_a_run() -> None:
    """20 s at 10 ms under the joints' torques alone."""
    given = scenario("initial_velocity={base_rotation_z: 0.05, base_position_x: 0.02}")
    record = simulate(given, blocks={"controller": Rock}, check_stability=False)
    assert record.outcome.status == "completed"
    assert record.metrics["contacts"]["gap"] < 1e-9
    data = record.dataset
    assert np.abs(data["velocity"].values[:, 6:]).max() > 0.01
    for name in ("linear_momentum", "angular_momentum"):
        momentum = data[name].values
        assert np.abs(momentum).max() > 1.0
        assert_allclose(momentum, momentum[:1].repeat(len(momentum), axis=0), rtol=0, atol=1e-9)


def test_the_recorded_wrench_moves_the_recorded_state() -> None:
    """Under the control of the sample before: the acceleration along it keeps the loop closed."""
    given = load_scenario("two_arms_capture", ["duration=0.5"])
    data = simulate(given, check_stability=False).dataset
    model = make_true_plant(given)
    chain = ClosedChain(model, given, true=True)
    for k in range(1, 50):
        q, v = data["position"].values[k], data["velocity"].values[k]
        force = data["applied_force"].values[k - 1] + data["force_disturbance"].values[k]
        A = chain.jacobian(q)
        acts = -data["contact_wrench"].values[k] @ A
        assert_allclose(data["force_contacts"].values[k], acts, atol=1e-9)
        rate = np.linalg.solve(model.calc_mass_matrix(q), force + acts - model.calc_bias(q, v))
        assert_allclose(A @ rate, -chain.bias(q, v), atol=1e-6)


def test_a_run_repeats_its_bits() -> None:
    given = load_scenario("two_arms", ["duration=0.5"])
    first, again = (simulate(given, check_stability=False) for _ in range(2))
    assert first.dataset.identical(again.dataset)


def test_a_compliant_contact_follows_its_spring() -> None:
    """The wrench of a compliant contact is stiffness times gap, and damping times its rate."""
    given = scenario(
        "duration=1", "contacts.right.kind=compliant", "simulator_config.max_step_size=0.001"
    )
    data = simulate(given, blocks={"controller": Push}, check_stability=False).dataset
    gap, wrench = data["contact_gap"].values, data["contact_wrench"].values
    rate = np.gradient(gap, 0.01, axis=0)
    spring = gap * np.repeat([500.0, 2e4], 3) + rate * np.repeat([5.0, 200.0], 3)
    assert np.abs(gap).max() > 1e-6
    assert_allclose(wrench[5:-5], spring[5:-5], rtol=0, atol=0.03 * np.abs(wrench).max())


@pytest.mark.parametrize("stiffness", [2e4, 3e5])
def test_the_step_that_a_spring_needs(stiffness: float) -> None:
    """The refusal's step runs; twice that is refused."""
    soft = [
        "contacts.right.kind=compliant",
        f"contacts.right.stiffness={stiffness}",
        f"contacts.right.rotational_stiffness={stiffness / 40}",
        "duration=0.5",
    ]
    with pytest.raises(ScenarioError, match=r"contacts.right.kind: its spring vibrates") as caught:
        make_closed_loop(scenario(*soft))
    step = float(str(caught.value).rpartition(" ")[2])
    with pytest.raises(ScenarioError, match=f" {step:g}$"):
        make_closed_loop(scenario(*soft, f"simulator_config.max_step_size={2 * step}"))
    given = scenario(*soft, f"simulator_config.max_step_size={step}")
    run = simulate(given, blocks={"controller": Push}, check_stability=False)
    assert run.outcome.status == "completed"
    assert run.metrics["contacts"]["gap"] < 1e-2


def test_a_flexible_panel_leaves_the_loop_closed() -> None:
    panel = {"position": [0, 1, 0], "direction": [0, 1, 0], "mass": 8.0, "frequency": 0.25}
    given = load_scenario(
        "two_arms",
        ["duration=2", "controller=computed_torque", {"model": {"flexible": {"port": panel}}}],
    )
    run = simulate(given, check_stability=False)
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert np.abs(run.dataset["hidden_position"].values).max() > 1e-8


def with_gear(joint: str, duration: float, forces: dict[str, object]) -> Scenario:
    """Two arms, one with a gear that bends."""
    gear = {"kind": "gear", "joint": joint, "stiffness": 1e5, "damping_ratio": 0.01}
    return scenario(
        f"duration={duration}",
        "controller=computed_torque",
        "simulator_config.max_step_size=0.002",
        "actuation.drives={rotor_inertia: {joints: 1.0e-4}, gear_ratio: {joints: 100}}",
        {"model": {"flexible": {"gear": gear}}, **forces},
    )


# forces on the deflection beside its spring
BACKLASH = {"effects": {"backlash": {"gap": {"gear": 1e-6}}}}
ORBIT = {"environment": {"altitude": 5e5}}


@pytest.mark.parametrize("forces", [{}, BACKLASH, ORBIT], ids=("spring", "backlash", "orbit"))
@pytest.mark.parametrize("joint", ["left_2", "right_3"])
def test_a_flexible_gear_leaves_the_loop_closed(joint: str, forces: dict[str, object]) -> None:
    """The contact also acts on the link behind the gear, and takes all forces on it as others."""
    given = with_gear(joint, 0.5, forces)
    run = simulate(given, check_stability=False, blocks={"controller": Push})
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert np.abs(run.dataset["hidden_position"].values).max() > 1e-8


@needs("compiled")
@needs_llvm
@pytest.mark.slow
@pytest.mark.parametrize("joint", ["left_2", "right_3"])
def test_a_flexible_gear_in_the_loop_is_compiled(joint: str) -> None:
    given = with_gear(joint, 0.5, BACKLASH | ORBIT)
    drake, compiled = (
        simulate(given, check_stability=False, engine=engine) for engine in ("drake", "compiled")
    )
    assert compiled.engine == "compiled"
    for name in ("position", "hidden_position", "contact_wrench"):
        found, expected = (run.dataset[name].values for run in (compiled, drake))
        assert_allclose(found, expected, rtol=0, atol=1e-9 * max(1.0, np.abs(expected).max()))


def test_one_contact_is_the_weld_of_the_model() -> None:
    left = scenario().contacts["left"]
    given = dataclasses.replace(scenario("duration=0.1"), contacts={"left": left})
    none = dataclasses.replace(given, contacts={})
    runs = [simulate(each, check_stability=False).dataset for each in (given, none)]
    assert np.array_equal(runs[0]["position"].values, runs[1]["position"].values)
