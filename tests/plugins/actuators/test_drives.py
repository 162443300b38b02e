"""Drives of the joints: friction and rotor inertia against closed forms, the rate limit, what the
forecast makes of it.

The spacecraft of the closed forms is two bodies that turn about one axis through both centres of
mass, so that a torque T of the joint gives its rate T / M with the reduced inertia M = I J / (I +
J).
"""

import numpy as np
import pytest
from balances import assert_momentum_follows
from pydrake.systems.framework import LeafSystem
from refusals import assert_refused

from ffsm_drake import ScenarioError, make_closed_loop, make_nominal_plant, simulate
from ffsm_drake.plugins.actuators.drives import DriveSet
from ffsm_drake.plugins.analysis.balances import energy_residual
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.runs.simulate import prepare
from ffsm_drake.scenario import Drives, scenario_from_dict
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.craft import make_true_plant

BASE, LINK = 10.0, 5.0  # kg m^2, about the axis; the link with its payload
REDUCED = BASE * LINK / (BASE + LINK)

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


class Torque(LeafSystem):
    """A controller that gives the joint a constant torque."""

    def __init__(self, value):
        super().__init__()
        self.DeclareVectorInputPort("estimated_state", 15)
        self.DeclareVectorInputPort("desired_state", 15)
        self.DeclareVectorInputPort("desired_acceleration", 7)
        force = np.r_[np.zeros(6), value]
        self.DeclareVectorOutputPort(
            "generalized_force", 7, lambda _, output: output.SetFromVector(force),
            {self.nothing_ticket()},
        )  # fmt: skip


@pytest.fixture(scope="module")
def two_bodies(tmp_path_factory):
    """two_bodies(rate, drives, ...) -> a scenario whose joint starts at a rate."""
    folder = tmp_path_factory.mktemp("two_bodies")
    for name, text in (("servicer", SERVICER), ("debris", DEBRIS)):
        (folder / f"{name}.urdf").write_text(text)

    def make(rate=0.0, drives=None, *, duration=1.0, step=1e-3, limit=None, torque=0.0):
        payload = {"mass": 20.0, "center_of_mass": [0, 0, 0], "inertia": [3.0, 3.0, 3.0]}
        return scenario_from_dict(
            {
                "duration": duration,
                "controller": "tdc",
                "controllers": {"tdc": {"k_d": 1.0, "k_p": 1.0}},
                "model": {
                    "servicer": str(folder / "servicer.urdf"),
                    "debris": str(folder / "debris.urdf"),
                    "directives": None,
                    "end_effector": "servicer::arm",
                    "grasp": "debris::debris",
                },
                "simulator_config": {"max_step_size": step},
                "payload": {"truth": payload, "nominal": payload},
                # at rest together: the joint's rate is of both bodies, against each other
                "initial_velocity": {
                    "hinge": rate,
                    "base_rotation_z": -rate * LINK / (BASE + LINK),
                },
                "actuation": {"drives": drives, "limit": limit},
                "disturbance": {"harmonics": {"hinge": {"bias": torque}}},
            }
        )

    return make


def coast(scenario, torque=0.0):
    """The run with a constant torque of the drive: record and the joint's rate."""
    blocks = {"controller": lambda _: Torque(torque)}
    record = simulate(scenario, blocks=blocks, check_stability=False)
    return record, record.dataset["velocity"].values[:, 6]


def assert_balanced(record):
    """Momentum is zero throughout, and energy what friction left, to 1e-9 of the work."""
    data = record.dataset
    assert np.abs(data["angular_momentum"].values).max() < 1e-12
    parts = energy_residual(data)
    turned = np.abs(data["friction_work"].values[-1].sum()) + parts["absolute_work"][-1]
    assert turned > 1e-4
    assert np.abs(parts["residual"]).max() < 1e-9 * turned


@pytest.mark.smoke
def test_viscous_friction_is_exponential(two_bodies):
    record, rate = coast(two_bodies(0.1, {"viscous_friction": 4.0}))
    time = record.dataset["time"].values
    assert rate == pytest.approx(0.1 * np.exp(-4.0 * time / REDUCED), rel=1e-10)
    assert record.dataset["friction_force"].values[:, 6] == pytest.approx(-4.0 * rate, rel=1e-12)
    assert not record.dataset["friction_force"].values[:, :6].any()
    assert_balanced(record)
    loss = record.metrics["drives"]["friction_loss"]["hinge"]
    assert loss == pytest.approx(0.5 * REDUCED * (rate[0] ** 2 - rate[-1] ** 2), rel=1e-9)


def test_coulomb_friction_stops_a_joint(two_bodies):
    """sinh(v / v_0) falls exponentially: v by F t / M until it is near v_0. Stops after M v / F."""
    coulomb, smoothing = 0.5, 2e-3
    drives = {"coulomb_friction": coulomb, "smoothing_rate": smoothing}
    record, rate = coast(two_bodies(0.1, drives, step=2.5e-4))
    time = record.dataset["time"].values
    fall = np.exp(-coulomb * time / (REDUCED * smoothing))
    exact = smoothing * np.arcsinh(np.sinh(0.1 / smoothing) * fall)
    assert rate == pytest.approx(exact, abs=1e-9)
    stop = REDUCED * 0.1 / coulomb  # 0.667 s
    before = time < stop - 0.05
    assert rate[before] == pytest.approx(0.1 - coulomb / REDUCED * time[before], abs=1e-6)
    assert 0.0 < rate[time > stop + 0.1].max() < 1e-3 * smoothing
    assert_balanced(record)
    assert record.metrics["drives"]["peak_friction"]["hinge"] == pytest.approx(coulomb)


def test_coulomb_and_viscous_friction_together(two_bodies):
    """v = (v(0) + F / b) exp(-b t / M) - F / b, and zero after M / b ln(1 + b v(0) / F)."""
    coulomb, viscous, smoothing = 0.3, 4.0, 2e-4
    drives = {"coulomb_friction": coulomb, "viscous_friction": viscous, "smoothing_rate": smoothing}
    record, rate = coast(two_bodies(0.1, drives, step=2e-4))
    time = record.dataset["time"].values
    stop = REDUCED / viscous * np.log(1.0 + viscous * 0.1 / coulomb)
    before = time < stop - 0.02
    assert before.sum() > 60
    exact = (0.1 + coulomb / viscous) * np.exp(-viscous * time / REDUCED) - coulomb / viscous
    assert rate[before] == pytest.approx(exact[before], abs=1e-9)
    assert np.abs(rate[time > stop + 0.03]).max() < 1e-3 * smoothing
    assert_balanced(record)


def test_stiction_holds_but_for_a_creep(two_bodies):
    """Below static friction the joint creeps at v_0 artanh(T / F); above it breaks away, and is
    held by less.
    """
    drives = {"coulomb_friction": 0.4, "static_friction": 0.6}
    drives |= {"stribeck_rate": 0.02, "smoothing_rate": 1e-3}
    step = 2e-3
    held, rate = coast(two_bodies(0.0, drives, step=step), torque=0.3)
    # exp(-(v / v_s)^2) is not quite 1
    assert rate[-1] == pytest.approx(1e-3 * np.arctanh(0.3 / 0.6), rel=2e-3)
    assert held.dataset["position"].values[-1, 7] < 1e-3
    record, rate = coast(two_bodies(0.0, drives, step=step, duration=2.0), torque=0.65)
    assert rate[-1] > 0.1
    assert np.diff(rate)[-1] / 0.01 == pytest.approx((0.65 - 0.4) / REDUCED, rel=1e-6)
    sliding = -record.dataset["friction_force"].values[:, 6]
    assert 0.5 < sliding.max() < 0.6
    assert sliding[-1] == pytest.approx(0.4, rel=1e-6)


def test_a_rotor_adds_its_inertia_times_the_ratio_squared(two_bodies):
    """Base and link feel the torque, the rotor turns with the joint: (J + N^2 J_r - J^2 / (I + J))
    a = T.
    """
    record, rate = coast(two_bodies(0.0, {"gear_ratio": 100, "rotor_inertia": 3e-4}), torque=2.0)
    data = record.dataset
    assert rate == pytest.approx(2.0 / (REDUCED + 3.0) * data["time"].values, rel=1e-11)
    assert np.abs(data["angular_momentum"].values).max() < 1e-12
    energy = 0.5 * (REDUCED + 3.0) * rate**2
    assert data["kinetic_energy"].values == pytest.approx(energy, rel=1e-10)
    assert np.abs(energy_residual(data)["residual"]).max() < 1e-9 * energy[-1]


def test_the_controller_knows_the_rotors_as_the_scenario_says(two_bodies):
    drives = {"gear_ratio": 100, "rotor_inertia": 3e-4}
    q = np.array([1.0, *np.zeros(7)])
    plain = make_nominal_plant(two_bodies()).calc_mass_matrix(q)[6, 6]
    for more, nominal in (
        ({}, 3.0),
        ({"nominal_rotor_inertia": 1e-4}, 1.0),
        ({"nominal_rotor_inertia": 0.0}, 0.0),
    ):
        scenario = two_bodies(0.0, drives | more)
        for make, added in ((make_nominal_plant, nominal), (make_true_plant, 3.0)):
            found = make(scenario).calc_mass_matrix(q)[6, 6]
            assert found == pytest.approx(plain + added)


def test_momentum_and_energy_of_the_whole_spacecraft(run):
    """Friction is inside the spacecraft: its momentum follows the base's force alone."""
    friction = (
        "actuation.drives={coulomb_friction: 0.05, static_friction: 0.06, "
        "viscous_friction: 0.2, rotor_inertia: 1e-5, gear_ratio: 100}"
    )
    record = run("postcapture", friction, "duration=5", "simulator_config.max_step_size=0.002")
    assert_momentum_follows(record.dataset, 1e-9)
    parts = energy_residual(record.dataset)
    lost = sum(record.metrics["drives"]["friction_loss"].values())
    assert lost > 1e-3
    assert np.abs(parts["residual"]).max() < 1e-9 * parts["absolute_work"][-1]
    without = record.dataset.drop_vars("friction_work")
    assert np.abs(energy_residual(without)["residual"]).max() == pytest.approx(lost, rel=1e-6)


def test_friction_is_no_force_of_the_controller(run):
    record = run("postcapture", "actuation.drives.coulomb_friction=0.05", "duration=1")
    data = record.dataset
    assert np.array_equal(data["applied_force"].values, data["generalized_force"].values)
    coordinates = make_nominal_plant(record.scenario).coordinates
    drives = DriveSet(record.scenario.actuation.drives, None, coordinates)
    rates = data["velocity"].values[:, 6:]
    assert data["friction_force"].values[:, 6:] == pytest.approx(drives.friction(rates), abs=1e-15)


def test_drives_that_do_nothing_change_no_bit(run):
    plain = run("postcapture", "duration=1")
    empty = run("postcapture", "duration=1", "actuation.drives={gear_ratio: 100}")
    for name in plain.dataset.data_vars:
        assert np.array_equal(plain.dataset[name].values, empty.dataset[name].values), name
    assert "actuation" not in make_closed_loop(empty.scenario).blocks


def test_force_falls_to_nothing_at_the_rate_limit(two_bodies):
    """With knee 0: v' = (T / M)(1 - v / v_m), held over samples."""
    scenario = two_bodies(0.0, {"rate_limit": 0.2, "knee": 0.0}, limit={"hinge": 3.0}, duration=2.0)
    record, rate = coast(scenario, torque=10.0)
    gain = 3.0 * 0.01 / (REDUCED * 0.2)
    assert rate == pytest.approx(0.2 * (1.0 - (1.0 - gain) ** np.arange(rate.size)), rel=1e-9)
    assert record.dataset["applied_force"].values[:, 6] == pytest.approx(
        3.0 * (1.0 - rate / 0.2), rel=1e-9
    )
    figures = record.metrics["drives"]
    assert figures["rate_used"]["hinge"] == pytest.approx(rate[-1] / 0.2)
    assert figures["force_used"]["hinge"] == pytest.approx(1.0)
    assert figures["rate_limited"] == pytest.approx(1.0 - 1.0 / rate.size)  # not at rest


def test_a_drive_brakes_at_any_rate():
    coordinates = Coordinates(("a", "b", "c"), ("rad",) * 3)
    settings = Drives(rate_limit={"a": 1.0, "b": 1.0}, knee={"all": 0.5})
    drives = DriveSet(settings, {"joints": 8.0}, coordinates)
    fast, slow = np.array([0.75, 2.0, 9.0]), np.array([0.5, 0.4, 0.1])
    wanted = np.array([7.0, 7.0, 7.0])
    assert drives.give(wanted, fast) == pytest.approx([4.0, 0.0, 7.0])
    assert drives.give(-wanted, -fast) == pytest.approx([-4.0, 0.0, -7.0])
    assert np.array_equal(drives.give(-wanted, fast), -wanted)
    assert np.array_equal(drives.give(wanted, slow), wanted)
    assert np.array_equal(drives.give(wanted, np.zeros(3)), wanted)


@pytest.mark.parametrize(
    ("drives", "slope"), [({"viscous_friction": 7.0}, 7.0), ({"coulomb_friction": 0.02}, 20.0)]
)
def test_the_forecast_sees_friction_at_its_slope(two_bodies, drives, slope):
    """Over a control sample the joint's rate falls by exp(-slope L / M), the base's turns with
    it.
    """
    scenario = two_bodies(0.0, drives, limit={"hinge": 1.0})
    with Linearizer(scenario, blocks={"controller": lambda _: Torque(0.0)}) as linearizer:
        (sample,) = linearizer.at(0.0).samples
    decay = np.exp(-slope * scenario.sample_time / REDUCED)
    assert sample.a[13, 13] == pytest.approx(decay, abs=1e-6)
    assert sample.a[9, 13] == pytest.approx((1.0 - decay) * LINK / (BASE + LINK), abs=1e-6)


def test_a_step_that_does_not_resolve_friction_is_refused_before_the_run(two_bodies):
    drives = {"static_friction": 1.0, "viscous_friction": 3.0, "smoothing_rate": 1e-2}
    constant = REDUCED / 103.0
    assert simulate(two_bodies(0.1, drives, step=0.99 * constant, duration=0.1)).outcome.completed
    coarse = two_bodies(0.1, drives, step=1.01 * constant)
    with pytest.raises(ScenarioError) as error:
        simulate(coarse)
    with pytest.raises(ScenarioError, match=r"max_step_size"):  # before the verdict, too
        prepare(coarse)
    assert str(error.value) == (
        "simulator_config.max_step_size: 0.0326861 s exceeds the time constant of friction near "
        "rest (hinge: 0.032 s); set at most 0.029, or 1.1 times actuation.drives.smoothing_rate"
    )
    coarse.simulator_config.integration_scheme = "radau3"
    make_closed_loop(coarse).diagram.CreateDefaultContext()


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("gear_ratio: 0", "gear_ratio.all: must be > 0, not 0"),
        (
            "rotor_inertia: {joint_1: -1}",
            "rotor_inertia.joint_1: must be >= 0 kg m^2, not -1",
        ),
        (
            "rotor_inertia: {elbow: 1}",
            "rotor_inertia.elbow: is not a joint; valid here: all, joints, joint",
        ),
        (
            "gear_ratio: {base_rotation: 2}",
            "gear_ratio.base_rotation: is not a joint; valid here: all, j",
        ),
        ("knee: 1", "knee.all: must be from 0 to below 1, not 1"),
        (
            "coulomb_friction: {joint_9: 1}",
            "coulomb_friction.joint_9: is not a joint",
        ),
        (
            "coulomb_friction: 0.2, static_friction: {joint_2: 0.1}",
            "static_friction: joint_2 has 0.1, less than its coulomb_friction, 0.2",
        ),
        ("smoothing_rate: 0", "smoothing_rate.all: must be > 0, not 0"),
        (
            "rate_limit: {joint_3: 0.1}",
            "rate_limit: joint_3 has no actuation.limit, below which its force",
        ),
    ],
)
def test_errors_are_one_clear_line(override, expected):
    override = f"actuation.drives={{{override}}}"
    assert_refused(f"actuation.drives.{expected}", "postcapture", override)
