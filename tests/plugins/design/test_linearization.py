"""The loop read from its wiring: against the loops of its axes, against known figures, and against
simulation.
"""

import dataclasses
import gc
import re
import weakref
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from outside_urdfs import TURN, joint, link, robot, rod
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Gain, RandomSource

from ffsm_drake import ControlLaw, gain, load_scenario, override_scenario, simulate
from ffsm_drake.common.errors import BlockError
from ffsm_drake.plugins.design.stability import stability
from ffsm_drake.plugins.design.stability.boundaries import find_boundaries
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear
from ffsm_drake.plugins.design.stability.linear_settings import NOT_LINEAR
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.mission import linear_verdict
from ffsm_drake.plugins.design.stability.one_axis import axis_loop
from ffsm_drake.scenario import Actuation, Drives, Thrusters, Wheel, Wheels
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers import PAPER_LAWS
from ffsm_drake.systems.registry import call_factory, find_factory

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.mark.parametrize(
    ("name", "overrides", "radius"),
    [
        ("postcapture", [], 0.98990),
        ("postcapture", ["sensing.delay=1"], 1.8942),
        ("postcapture", ["actuation.delay=1"], 1.4288),
        ("postcapture", ["controller=tdc"], 0.98995),
        ("postcapture", ["controller=pd_plus"], 0.99964),
        ("postcapture", ["controller=computed_torque"], 0.96266),
        ("flight_sensors", [], 0.99950),
        ("flight_sensors", ["sensing.delay=4", "estimator.delay=0"], 1.0246),
        ("flight_sensors", ["sensing.delay=5", "estimator.delay=0"], 1.0435),
    ],
)
def test_spectral_radius(name, overrides, radius):
    """Figures of an independent prototype, at the start of the shipped motion."""
    with Linearizer(load_scenario(name, overrides)) as linearizer:
        assert linearizer.at(0.0).spectral_radius == pytest.approx(radius, abs=1e-4)


@pytest.mark.parametrize("name", ["postcapture", "flight_sensors"])
@pytest.mark.parametrize("controller", PAPER_LAWS)
def test_poles_are_those_of_the_axes(name, controller):
    """With the true payload the axes do not meet; the plant's velocity half-way changes fast poles
    a little.
    """
    same = ["payload.nominal.mass=100", "payload.nominal.inertia=[16.7, 16.7, 16.7]"]
    scenario = load_scenario(name, [f"controller={controller}", *same])
    with Linearizer(scenario) as linearizer:
        found = linearizer.at(10.0)
    expected = axis_loop(linearizer.law.by_axis).spectral_radius.max()
    assert found.spectral_radius == pytest.approx(expected, abs=2e-4 if expected > 0.9 else 5e-3)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Damper(ControlLaw):
    """A user's law with memory that only counts, which is not part of the loop."""

    model: PlantModel
    k_p: np.ndarray = gain(4.0)
    k_d: np.ndarray = gain(5.0)

    def initial_state(self):
        return {"count": np.zeros(1)}

    def step(self, sample, state):
        u = sample.a_d + self.k_d * sample.e_dot + self.k_p * sample.e
        force = self.model.calc_mass_matrix(sample.q) @ u + self.model.calc_bias(sample.q, sample.v)
        return force, {"count": state["count"] + 1.0}


@pytest.mark.smoke
def test_modes_of_a_users_law_are_those_of_its_gains():
    """Computed torque with its poles at -1 and -4 1/s, on a nominal payload that is the true
    one.
    """
    blocks = {"controller": Damper}
    same = ["payload.nominal.mass=100", "payload.nominal.inertia=[16.7, 16.7, 16.7]"]
    with Linearizer(load_scenario("postcapture", same), blocks=blocks) as linearizer:
        loop = linearizer.at(0.0)
    assert loop.spectral_radius == pytest.approx(np.exp(-1.0 * 0.01), abs=2e-4)
    mode = loop.modes(1)[0]
    assert mode.frequency == pytest.approx(1.0, rel=0.02)
    assert mode.damping == pytest.approx(1.0, abs=1e-3)
    assert sum(mode.coordinates.values()) == pytest.approx(1.0)
    assert next(iter(mode.coordinates.values())) == max(mode.coordinates.values())


@pytest.mark.parametrize(
    ("name", "law"),
    [("postcapture", "tde_aismc"), ("tumbling_capture", "tdc"), ("free_floating", "resolved_rate")],
)
def test_a_users_copy_of_a_law_has_its_loop(name, law):
    """Equal to rounding, which the differences' steps of 1e-7 magnify."""
    scenario = load_scenario(name, [f"controller={law}"])

    def made(setup):
        own = dataclasses.replace(setup, name=law, settings=scenario.controllers.get(law, {}))
        return call_factory(find_factory("controller", law), own, place=law)

    def copied(setup):
        own = made(setup)
        return type("Own", (type(own),), {})(**vars(own))

    loops = []
    for factory in (made, copied):
        with Linearizer(scenario, blocks={"controller": factory}) as linearizer:
            assert not linearizer.is_exact
            assert bool(linearizer.user_supplied) is (factory is copied)
            loops.append(linearizer.at(linearizer.part(0.3)))
    for part in "abc":
        found, expected = (getattr(loop.samples[0], part) for loop in loops)
        scale = max(1.0, np.abs(expected).max(initial=0.0))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7 * scale)


class Lag(LeafSystem):
    """Actuators with a lag of 50 ms: state that is continuous."""

    def __init__(self, setup):
        super().__init__()
        size = len(setup.coordinates.names)
        self.lag = 0.05
        self.command = self.DeclareVectorInputPort("commanded_force", size)
        state = self.DeclareContinuousState(size)
        self.DeclareStateOutputPort("applied_force", state)

    def DoCalcTimeDerivatives(self, context, derivatives):
        force = context.get_continuous_state_vector().CopyToVector()
        derivatives.SetFromVector((self.command.Eval(context) - force) / self.lag)


class Fast(LeafSystem):
    """Actuators that take the command over every millisecond."""

    def __init__(self, setup):
        super().__init__()
        size = len(setup.coordinates.names)
        self.command = self.DeclareVectorInputPort("commanded_force", size)
        state = self.DeclareDiscreteState(size)
        self.DeclareStateOutputPort("applied_force", state)
        self.DeclarePeriodicDiscreteUpdateEvent(0.001, 0.0005, self.take)

    def take(self, context, values):
        values.set_value(0.5 * (context.get_discrete_state(0).value() + self.command.Eval(context)))


@pytest.mark.parametrize(
    ("actuators", "words"), [(Lag, "continuous or abstract state"), (Fast, "between two control")]
)
def test_what_it_cannot_linearise_is_refused(actuators, words):
    with (
        pytest.raises(BlockError, match=words),
        Linearizer(load_scenario("postcapture"), blocks={"actuation": actuators}) as linearizer,
    ):
        linearizer.at(0.0)


def noise(setup):
    """A force that is noise and nothing else: its output is that of the source itself."""
    builder = DiagramBuilder()
    source = builder.AddSystem(
        RandomSource(RandomDistribution.kGaussian, len(setup.coordinates.names), 0.01)
    )
    builder.ExportOutput(source.get_output_port(), "generalized_force")
    return builder.Build()


def half_of_noise(setup):
    """Noise that the block hears itself."""
    builder, size = DiagramBuilder(), len(setup.coordinates.names)
    source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, size, 0.01))
    half = builder.AddSystem(Gain(0.5, size))
    builder.Connect(source.get_output_port(), half.get_input_port())
    builder.ExportOutput(half.get_output_port(), "generalized_force")
    return builder.Build()


@pytest.mark.parametrize("force", [noise, half_of_noise])
def test_the_run_without_noise_has_none(force):
    """It is the simulation without noise, also where a force is noise."""
    silent = load_scenario(
        "postcapture", ["controller=tdc", "sensing.velocity_noise=0", "duration=1"]
    )
    error = simulate(silent, check_stability=False).dataset["error"].values[:-1]
    noisy = load_scenario("postcapture", ["controller=tdc", "duration=1"])
    with Linearizer(noisy, blocks={"forces.noise": force}) as linearizer:
        followed, _ = linearizer.follow()
    assert np.abs(followed - error).max() < 1e-6 * np.abs(error).max()


@settings(max_examples=8, deadline=None)
@given(power=st.floats(0.0, 18.0))
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_run_without_noise_ends_where_it_diverges(power):
    """However large the gains: nothing overflows, and what follows is unknown."""
    gains = [f"controllers.tdc.{name}={40.0 * 10.0**power}" for name in ("k_d", "k_p")]
    scenario = load_scenario("flight_sensors", ["controller=tdc", "duration=1", *gains])
    with Linearizer(scenario) as linearizer:
        error, _ = linearizer.follow()
    unknown = np.isnan(error).any(axis=1)
    assert unknown[-1] == unknown.any()
    assert unknown.any() or power < 1.0
    assert not unknown.any() or unknown[np.argmax(unknown) :].all()


def test_another_payload_is_that_of_another_scenario():
    """At rest, where the plant is as near to the plan with one payload as with another."""
    light = ["payload.truth.mass=48", "payload.truth.inertia=[8, 8, 8]"]
    scenario, lighter = (
        load_scenario("postcapture", ["controller=tdc", *truth]) for truth in ([], light)
    )
    with Linearizer(scenario) as linearizer, Linearizer(lighter) as other:
        own = linearizer.at(0.0).spectral_radius
        found = linearizer.at(0.0, truth=lighter.payload.truth).spectral_radius
        assert found == pytest.approx(other.at(0.0).spectral_radius, abs=2e-5)
        assert own < 1.0 < found
        assert linearizer.at(0.0).spectral_radius == own


def test_a_force_of_the_wheels_momentum_stands_in_the_loop(monkeypatch):
    """The linear loop's actuators are ideal, and hold no momentum that coils could take."""
    monkeypatch.syspath_prepend(EXAMPLES)
    scenario = load_scenario("thrusters_and_wheels", ["controller=tdc"])
    coils = override_scenario(scenario, ["blocks.forces.coils=own_torquers:Coils"])
    radii = []
    for each in (scenario, coils):
        with Linearizer(each) as linearizer:
            radii.append(linearizer.at(0.0).spectral_radius)
    assert "forces.coils" in linearizer._loop.sample.loop.blocks
    assert radii[1] == pytest.approx(radii[0], rel=1e-7)


def test_it_is_freed():
    with Linearizer(load_scenario("postcapture"), blocks={"controller": Damper}) as linearizer:
        diagram = weakref.ref(linearizer._loop.sample.loop.diagram)
    del linearizer
    gc.collect()
    assert diagram() is None


@pytest.mark.parametrize(
    ("name", "overrides", "stable"),
    [
        ("postcapture", ["sensing.delay=1"], False),
        pytest.param(
            "postcapture",
            ["controller=computed_torque", "sensing.delay=1", "duration=8"],
            True,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "flight_sensors",
            ["sensing.delay=4", "estimator.delay=0"],
            False,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "flight_sensors", ["sensing.delay=6", "duration=6"], True, marks=pytest.mark.slow
        ),
        ("flight_sensors", ["actuation.delay=4", "controller=pd_plus", "duration=8"], True),
    ],
)
def test_delays_against_simulation(name, overrides, stable):
    scenario = load_scenario(name, overrides)
    margins = stability(scenario)
    assert margins.is_stable == stable
    assert linear_verdict(scenario).is_alarm == (not stable)
    assert simulate(scenario, check_stability=False).outcome.completed == stable


@pytest.mark.long
def test_boundaries_of_the_closed_form():
    """AISMC: (K_D + K_s) L < 2 at eta = 1, in the gains as in the sample time.

    All coordinates have the same poles there, which rounding moves by far more than itself: on
    three kinds of processor the boundaries were 0.1 to 0.4 % too low.
    """
    gains = ["controllers.aismc.k_s_initial=80", "controllers.aismc.k_s_max=80"]
    same = ["payload.nominal.mass=100", "payload.nominal.inertia=[16.7, 16.7, 16.7]"]
    found = find_boundaries(
        load_scenario("postcapture", ["controller=aismc", *gains, *same]), time=0.0
    )
    assert found.gains == pytest.approx(2.0 / (180.0 * 0.01), rel=1e-2)
    assert found.sample_time == pytest.approx(2.0 / (180.0 * 0.01), rel=1e-2)
    assert found.delay == 0.0


@dataclasses.dataclass
class LaterActuation(Actuation):
    """With a setting that nothing here knows."""

    backlash: float = 0.0


@dataclasses.dataclass
class LaterDrives(Drives):
    """Likewise."""

    ripple: float = 0.0


def test_every_setting_of_the_actuators_is_kept_or_named():
    """One that is neither would vanish from every statement about stability."""
    some, wheel = {"all": 0.25}, {"torque_limit": 0.1}
    drives = LaterDrives(
        gear_ratio=some,
        rotor_inertia=some,
        nominal_rotor_inertia=some,
        rate_limit=some,
        knee=some,
        ripple=0.1,
        coulomb_friction=some,
        static_friction=some,
        stribeck_rate=some,
        viscous_friction=some,
        smoothing_rate=some,
    )
    wheels = Wheels(units={"xyz"[i]: Wheel(axis=np.eye(3)[i].tolist(), **wheel) for i in range(3)})
    given = LaterActuation(
        driven=["base_rotation", "joints"],
        limit={"all": 5.0},
        quantization=some,
        delay=1,
        backlash=0.1,
        thrusters=Thrusters(layout="12x5N"),
        wheels=wheels,
        drives=drives,
    )
    with Linearizer(
        dataclasses.replace(load_scenario("postcapture"), actuation=given)
    ) as linearizer:
        found = linearizer.scenario.actuation
    parts = {
        "actuation": (given, found, LaterActuation(drives=drives)),
        "drives": (drives, found.drives, LaterDrives()),
    }
    for part, (before, after, plain) in parts.items():
        for name in (field.name for field in dataclasses.fields(before) if field.name != "drives"):
            old, default = getattr(before, name), getattr(plain, name)
            assert old != default, f"{name}: give it another value than its default"
            assert getattr(after, name) == (default if name in NOT_LINEAR[part] else old), name


@settings(derandomize=True, database=None, deadline=None, max_examples=20)
@given(
    st.sampled_from(("actuation.delay={}", "sensing.delay={}")),
    st.integers(100, 1000),
)
@example("actuation.delay={}", 130)
def test_a_loop_that_would_take_minutes_is_refused_by_its_size(key, samples):
    """Counts of states, of the period and of evaluations, at least one of them beyond its bound."""
    with pytest.raises(NotLinear, match="the linear loop is too large") as caught:
        Linearizer(load_scenario("postcapture", [key.format(samples)]))
    counts = re.findall(r"(\d+) [a-z ]+\(limit (\d+)", str(caught.value))
    assert len(counts) == 3
    assert any(int(count) > int(bound) for count, bound in counts)


def test_memory_without_entries_is_no_part_of_the_loop():
    """The one-sample estimate has no bias to estimate: a group of size zero before the noise."""
    radii = [
        stability(load_scenario("flight_sensors", ["controller=tdc", {"estimator": estimator}]))
        .loops[0]
        .spectral_radius
        for estimator in (
            {"kind": "one_sample"},
            {"kind": "one_sample", "velocity_bias_walk": {"base_rotation": 1e-6}},
        )
    ]
    assert radii[1] == radii[0]


def test_noise_of_the_bases_sensors_is_in_its_axes():
    """In a base that is turned by 90 degrees about x, noise about its z is noise about -y."""
    still = "{base_rpy: [1.5707963267948966, 0, 0]}"
    given = ["controller=tdc", f"initial_posture={still}", f"target_posture={still}"]
    given += [f"{section}.velocity_noise={{all: 1e-5}}" for section in ("estimator", "sensing")]
    maps = []
    for more in ((), ("sensing.velocity_noise.base_rotation_z=3e-5",)):
        with Linearizer(load_scenario("flight_sensors", [*given, *more])) as linearizer:
            loop = linearizer.at(1.0)
            maps.append(loop.samples[0].d[:, loop.noise["samples"]])
    nq = len(loop.coordinates.position_names)
    alike, turned = (noise[:, nq : nq + 6] for noise in maps)
    scale = 1e-5 * np.abs(alike).max()
    assert np.abs(alike[:, :3]).max() > 1e3 * scale
    assert turned[:, 2] == pytest.approx(-3.0 * alike[:, 1], abs=scale)
    assert turned[:, 1] == pytest.approx(alike[:, 2], abs=scale)
    assert turned[:, [0, 3]] == pytest.approx(alike[:, [0, 3]], abs=scale)


def light_arm(folder, count=7, length=0.2, mass=0.8):
    """Joints about z and y in turn: seven swing the elbow without moving the target."""
    names = ["bus", *(f"link_{k}" for k in range(1, count + 1))]
    path = folder / "light.urdf"
    path.write_text(
        robot(
            link("bus", mass=400.0, inertia=(200.0, 200.0, 150.0)),
            *(rod(name, length, mass) for name in names[1:]),
            *(
                joint(
                    f"joint_{k + 1}",
                    names[k],
                    names[k + 1],
                    axis=("0 0 1", "0 1 0")[k % 2],
                    xyz=f"0 0 {length if k else 0.6}",
                    limit=TURN,
                )
                for k in range(count)
            ),
            link("tool"),
            joint("palm", names[-1], "tool", kind="fixed", xyz=f"0 0 {length}"),
        )
    )
    return path


def light_scenario(folder, law, k_d=40.0, **arm):
    start = [0.5, 0.45, -0.25, -0.9, 0.4, 0.8, 0.35][: arm.get("count", 7)]
    gains = {"k_d": k_d} | ({} if law == "asmc" else {"k_p": k_d**2 / 4})
    return load_scenario("postcapture").replace(
        model={"servicer": str(light_arm(folder, **arm)), "directives": None,
               "end_effector": "servicer::tool"},
        initial_posture={"joints": {f"joint_{k}": x for k, x in enumerate(start, 1)}},
        target_posture={"joints": {f"joint_{k}": 2 * x for k, x in enumerate(start, 1)}},
        controller=law,
        controllers={law: gains},
    )  # fmt: skip


@pytest.mark.parametrize("law", ["aismc", "asmc", "tdc"])
def test_a_light_motion_of_the_elbow_is_linearised_on_the_plan(tmp_path, law):
    """The first samples of a warm-up, without an estimate, throw it off the plan. All axes have the
    same gains, so the poles nearest to instability stay where they are at rest.
    """
    with Linearizer(light_scenario(tmp_path, law)) as linearizer:
        radii = [loop.spectral_radius for loop in linearizer.along()]
    assert max(radii) == pytest.approx(radii[-1], abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_light_arms_are_linearised_on_the_plan(tmp_path, seed):
    rng = np.random.default_rng([51, seed])
    law = ("tdc", "aismc", "asmc")[seed % 3]
    arm = {"count": int(rng.integers(5, 8)), "length": rng.uniform(0.15, 0.3)}
    scenario = light_scenario(tmp_path, law, rng.uniform(15, 45), mass=rng.uniform(0.6, 2), **arm)
    with Linearizer(scenario) as linearizer:
        radii = [loop.spectral_radius for loop in linearizer.along()]
    assert max(radii) == pytest.approx(radii[-1], abs=2e-3)


def kicked(folder, seed):
    """A drawn light arm with a law of boundary layers: the first samples of a warm-up amid its fast
    motion throw it out of the layers.
    """
    rng = np.random.default_rng([52, seed])
    law = ("super_twisting", "terminal_sliding_mode", "fixed_time")[seed % 3]
    count = int(rng.integers(5, 8))
    start = rng.uniform(-0.6, 0.6, count)
    end = start + rng.uniform(-1.4, 1.4, count)
    arm = light_arm(folder, count, rng.uniform(0.2, 0.35), rng.uniform(0.5, 1.5))
    center = [0.0, 0.0, 0.0]
    return load_scenario("postcapture").replace(
        model={"servicer": str(arm), "directives": None, "end_effector": "servicer::tool"},
        payload={
            "body": "debris::debris",
            "truth": {"mass": 17.0, "center_of_mass": center, "inertia": [2.8, 2.8, 2.8]},
            "nominal": {"mass": 15.0, "center_of_mass": center, "inertia": [2.4, 2.4, 2.4]},
        },
        initial_posture={"joints": {f"joint_{k}": float(x) for k, x in enumerate(start, 1)}},
        target_posture={"joints": {f"joint_{k}": float(x) for k, x in enumerate(end, 1)}},
        controller=law,
        controllers={},
        reference={"duration": 9.0},
        duration=13.0,
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 5, 6, 8])
def test_a_loop_that_only_a_warm_up_throws_off_is_stable(tmp_path, seed):
    """As its run is, which begins at rest."""
    scenario = kicked(tmp_path, seed)
    assert linear_verdict(scenario).status == "stable"
    record = simulate(scenario, check_stability=False)
    assert record.outcome.completed
    error = np.abs(record.dataset["error"].values)
    assert error.max() < 0.01
    assert error[-100:].max() < 1e-3


@pytest.mark.slow
def test_a_loop_that_diverges_at_once_is_told_so(tmp_path):
    scenario = kicked(tmp_path, 1)
    assert simulate(scenario, check_stability=False).outcome.time < 0.2
    found = linear_verdict(scenario)
    assert found.status == "unstable"
    assert "inf" not in found.sentence
    assert "the loop diverges from the plan within 5 samples" in found.sentence
