"""Control laws in the closed chain: internal force, load sharing, and what fails without."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ffsm_drake import (
    BlockError,
    ControlLaw,
    Scenario,
    ScenarioError,
    load_scenario,
    make_nominal_plant,
    simulate,
)
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.plugins.two_arms.growth import growth
from ffsm_drake.runs.exceeded_limits import broken_limits
from ffsm_drake.scenario import PerCoordinate
from ffsm_drake.systems.controllers import PAPER_LAWS, controller_names

CALIBRATION = (  # 1 mrad of each encoder, 1 mm at the hand
    f"sensing.position_bias={{{', '.join(f'right_{k}: 1e-3' for k in range(1, 7))}}}",
    "contacts.right.position_error=[1e-3, 0, 0]",
)
QUIET = ("sensing.velocity_noise=0", "disturbance.amplitude_scale=0")
KNOWN = "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}"


def scenario(*overrides: str) -> Scenario:
    return load_scenario("two_arms", [*overrides])


def at_rest(given: Scenario) -> Scenario:
    return dataclasses.replace(given, initial_posture=given.target_posture)


@pytest.mark.parametrize("law", PAPER_LAWS)
def test_calibration_errors_leave_a_small_internal_force(law: str) -> None:
    given = scenario(f"controller={law}", *CALIBRATION, "duration=3")
    contacts = simulate(given, check_stability=False).metrics["contacts"]
    assert contacts["force_at_end"] < 1.0
    assert contacts["moment_at_end"] < 2.0


@pytest.mark.long
@pytest.mark.parametrize("law", PAPER_LAWS)
def test_the_internal_force_stays_below_1_newton_in_20_runs(law: str) -> None:
    for seed in range(20):
        given = scenario(f"controller={law}", *CALIBRATION, f"random_seed={seed}")
        run = simulate(given, check_stability=False)
        assert run.outcome.status == "completed"
        assert run.metrics["contacts"]["force"] < 1.0
        assert run.metrics["contacts"]["moment"] < 2.0


@pytest.mark.slow
def test_noise_at_the_wrist_shakes_the_internal_force() -> None:
    """F' = F - g (F + n) with the gain g a sample: deviation sqrt(g / (2 - g)) of the noise's."""
    noise = ("contacts.right.force_noise=2", "contacts.right.moment_noise=0.2")
    runs = [
        simulate(scenario(*QUIET, *each, "duration=8"), check_stability=False)
        for each in ((), noise)
    ]
    wrenches = [run.dataset["contact_wrench"].values for run in runs]
    found = (wrenches[1] - wrenches[0])[100:].reshape(-1, 2, 3).std(axis=(0, 2))
    assert_allclose(found, np.array([0.2, 2.0]) * np.sqrt(0.05 / 1.95), rtol=0.15)


@pytest.mark.smoke
def test_a_law_that_is_not_adapted_winds_up_unseen_in_the_errors() -> None:
    runs = [
        simulate(
            scenario("controller=tdc", f"chain.law={law}", *CALIBRATION, "duration=3"),
            check_stability=False,
        )
        for law in ("plain", "minimal")
    ]
    forces = [run.metrics["contacts"]["force_at_end"] for run in runs]
    assert forces[0] > 100.0 * forces[1]
    left = [np.abs(run.dataset["error"].values[-1, :12]).max() for run in runs]
    assert left[0] < 0.01


@pytest.mark.parametrize("law", ["tdc", "asmc"])
@pytest.mark.parametrize("overrides", [CALIBRATION[:1], CALIBRATION[1:]], ids=["encoders", "hand"])
def test_the_ramp_is_foretold(law: str, overrides: tuple[str, ...]) -> None:
    """Within 10 %, at rest."""
    small = [each.replace("1e-3", "1e-4") for each in overrides]
    given = at_rest(scenario(f"controller={law}", "chain.law=plain", *QUIET, *small, "duration=4"))
    with Linearizer(given) as linearizer:
        assert linearizer.at(linearizer.end).unit_poles == 6
        reference = linearizer.motion.evaluate(linearizer.end)[0]
        foretold = growth(make_mission(linearizer.scenario), linearizer.law, reference)
    wrench = simulate(given, check_stability=False).dataset["contact_wrench"].values
    force = np.linalg.norm(wrench[:, 3:], axis=1)
    grown = foretold.force[-1] - foretold.force[-101]
    assert_allclose(grown, force[-1] - force[-101], rtol=0.1)
    assert_allclose(foretold.force[-1], force[-1], rtol=0.1)
    assert not foretold.is_example


@pytest.mark.long
def test_the_verdict_tells_of_the_internal_force() -> None:
    plain = verdict(scenario("controller=tdc", "chain.law=plain"), rehearsal=False)
    assert any("6 poles at one" in line and "chain.law: minimal" in line for line in plain.lines)
    assert plain.is_linearly_unstable
    adapted = verdict(scenario("controller=tdc"), rehearsal=False)
    assert not adapted.is_linearly_unstable
    assert "poles at one" not in "".join(adapted.lines)


@pytest.mark.slow
def test_the_target_is_shared_and_pressed_as_wanted() -> None:
    """The right hand's wrench: the share of what moves the target, and the preload."""
    runs = [
        simulate(
            scenario(
                "controller=tdc", *QUIET, KNOWN, "duration=4", "reference.duration=4",
                f"chain.force={{share: 0.5, gain: 50, preload: {preload}}}",
            ),
            check_stability=False,
        ).dataset
        for preload in ([0] * 6, [0, 0, 1, 0, 0, 5])
    ]  # fmt: skip
    one, other = (run["contact_wrench"].values for run in runs)
    assert_allclose(other[100:] - one[100:], np.tile([0, 0, 1, 0, 0, 5], (301, 1)), atol=1e-2)
    model = make_nominal_plant(scenario(KNOWN))
    q, v, a = (
        runs[0][f"desired_{name}"].values for name in ("position", "velocity", "acceleration")
    )
    motion = model.calc_frame_motion(q, v, a, "debris::debris")
    needed = 100.0 * np.linalg.norm(motion[:, 16:], axis=1)
    taken = np.linalg.norm(one[:, 3:], axis=1)
    assert needed.max() > 5.0
    assert_allclose(taken[100:], 0.5 * needed[100:], atol=0.05 * needed.max())


def test_force_limits_share_the_torques() -> None:
    """The force of the arm with smaller limits is smaller; that on the base does not change."""
    weak = {f"right_{k}": 2.0 for k in range(1, 7)} | {"all": 20.0}
    limits: list[PerCoordinate | None] = [None, weak]
    forces = []
    for limit in limits:
        given = scenario(*QUIET, "controller=tdc", "duration=2", "chain.force=null")
        given = given.replace(actuation={"limit": limit})
        data = simulate(given, check_stability=False).dataset
        forces.append(np.abs(data["generalized_force"].values[:100]).mean(axis=0))
    assert_allclose(forces[0][:6], forces[1][:6], rtol=1e-3, atol=1e-3)
    assert forces[1][12:].sum() < 0.2 * forces[0][12:].sum()


def test_computed_torque_tracks_in_minimal_velocities() -> None:
    """With the exact model, the error stays at the integrator's."""
    given = scenario("controller=computed_torque", *QUIET, KNOWN, "duration=4")
    errors = simulate(given, check_stability=False).dataset["error"].values
    assert np.abs(errors).max() < 1e-4


def test_the_chains_model_is_that_of_the_constrained_tree() -> None:
    """S' H S and the bias, against the tree's inverse dynamics along the chain's motion."""
    given = scenario(KNOWN)
    nominal = make_nominal_plant(given)
    seen = []

    class Watch(ControlLaw):
        def __init__(self, model):
            self.model = model

        @classmethod
        def from_setup(cls, setup):
            seen.append(setup.nominal)
            return cls(setup.nominal)

        def step(self, sample, state):
            return 0.0 * sample.e, state

    simulate(scenario(KNOWN, "duration=0.01"), blocks={"controller": Watch}, check_stability=False)
    chain, generator = seen[0], np.random.default_rng(0)
    q = ClosedChain(nominal, given, true=False).closed(nominal.plant.GetPositions(chain.context))
    nu, rate = generator.normal(size=12), generator.normal(size=12)
    constraints, whole, _ = chain.calc_map(q)
    assert_allclose(constraints @ whole, 0.0, atol=1e-12)
    v = whole @ nu
    # any dv/dt with A dv/dt = -dA/dt v whose minimal part is the rate
    a = whole @ rate
    change = np.linalg.lstsq(
        constraints[:, chain.following],
        -chain.constraints.bias(q, v) - constraints @ a,
        rcond=None,
    )[0]
    a[chain.following] += change
    hand = nominal.plant.GetFrameByName("left_hand")
    own, whole_motion = chain.calc_frame_motion(q, nu, rate, hand), (q, v, a, hand)
    assert_allclose(own, nominal.calc_frame_motion(*whole_motion), rtol=1e-9, atol=1e-9)
    expected = whole.T @ nominal.calc_inverse_dynamics(q, v, a)
    assert_allclose(chain.calc_inverse_dynamics(q, nu, rate), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("law", controller_names())
def test_every_law_works_in_the_chain(law: str) -> None:
    run = simulate(scenario(f"controller={law}", "duration=0.1"), check_stability=False)
    assert run.outcome.status == "completed"
    assert np.abs(run.dataset["error"].values).max() < 1e-3
    assert run.metrics["contacts"]["force"] < 1.0


# It turns against the momentum, and has no plan.
@pytest.mark.long
@pytest.mark.parametrize("law", [*{*controller_names()} - {"torque_against_momentum"}])
def test_every_law_settles_in_the_chain(law: str) -> None:
    """With 1 mrad and 1 mm; the joints that follow keep the error of their calibration. PD+, which
    has no estimate, is 6 mrad off, which the others multiply to 43 mrad.
    """
    run = simulate(scenario(f"controller={law}", *CALIBRATION), check_stability=False)
    assert run.outcome.status == "completed"
    scale = 12.0 if law == "pd_plus" else 1.0
    errors = np.abs(run.dataset["error"].values[-100:])
    assert errors[:, :12].max() < scale * 1.5e-3
    assert errors[:, 12:].max() < scale * 4e-3
    assert run.metrics["contacts"]["force"] < 1.0
    assert run.metrics["contacts"]["moment"] < 2.0


class Stubborn(ControlLaw):
    """A law of the velocities of the whole spacecraft."""

    @classmethod
    def from_setup(cls, setup):
        return cls()

    def step(self, sample, state):
        return np.ones(18) * sample.e_dot, state


def test_a_law_of_all_velocities_is_refused() -> None:
    with pytest.raises(BlockError, match="Stubborn' needs the velocities of all joints"):
        simulate(scenario("duration=0.1"), blocks={"controller": Stubborn}, check_stability=False)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["mpc", "nmpc"])
def test_predicted_forces_of_the_joints_keep_to_their_limits(law: str) -> None:
    """The law gives n forces, and the joints share them: the limits are those of the joints."""
    limits = [f"actuation.limit={{joints: {most}}}" for most in (100, 0.5)]
    quick = (*QUIET, "chain.force=null", "duration=4", "reference.duration=4")
    runs = [
        simulate(scenario(f"controller={law}", *quick, limit), check_stability=False).dataset
        for limit in limits
    ]
    free, held = (np.abs(run["generalized_force"].values[:, 6:]).max() for run in runs)
    assert free > 0.6
    assert held < 0.5 + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "force", "remedy"),
    [
        ("plain", "{}", "set chain.law: minimal"),
        ("minimal", "{}", "set contacts.right.stabilization above 0"),
        ("minimal", "{gain: 0}", "set contacts.right.stabilization above 0"),
    ],
)
def test_a_pole_at_one_is_told_with_a_remedy_that_is_not_in_effect(
    law: str, force: str, remedy: str
) -> None:
    given = scenario(
        f"chain.law={law}",
        f"chain.force={force}",
        "controller=tdc",
        f"contacts.right.stabilization={50 if law == 'plain' else 0}",
    )
    (line,) = [line for line in verdict(given, rehearsal=False).lines if line.startswith("linear")]
    assert "at one" in line
    assert remedy in line
    assert f"set chain.law: {law}" not in line


@pytest.mark.parametrize("closes", [0, 0.5])
def test_a_compliant_chain_is_refused_in_minimal_velocities(closes: float) -> None:
    given = load_scenario(
        "two_arms_capture", ["contacts.right.kind=compliant", f"contacts.right.closes={closes}"]
    )
    with pytest.raises(ScenarioError, match=r"contacts.right.kind: .*set chain.law: plain$"):
        simulate(given, check_stability=False)


@pytest.mark.parametrize(
    "overrides",
    [["estimator.kind=kalman"], ["estimator.kind=coupled"], ["command_filter.low_pass=20"]],
    ids=["kalman", "coupled", "filtered"],
)
def test_estimators_and_filters_work_in_the_chain(overrides: list[str]) -> None:
    given = scenario(*overrides, "duration=1")
    run = simulate(given, check_stability=False)
    assert run.outcome.status == "completed"
    assert run.metrics["contacts"]["force_at_end"] < 2.0


def test_a_run_beyond_the_limits_of_a_contact_says_so() -> None:
    given = scenario("duration=1", "contacts.right.force_limit=0.05")
    (line,) = broken_limits(make_mission(given), simulate(given, check_stability=False).dataset)
    assert line.startswith("the run exceeds contacts.right.force_limit: right_force_x")
