"""Crafts of unusual kinds, targets of several links, and sizes that follow from mass and reach."""

import dataclasses
import itertools
import re
import types
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from outside_urdfs import TURN, joint, link, robot

from ffsm_drake.cli import main
from ffsm_drake.common.errors import ModelError, ScenarioError
from ffsm_drake.plugins.new import approach
from ffsm_drake.plugins.new.asked import Asked, WheelData
from ffsm_drake.plugins.new.base_box import BaseBox
from ffsm_drake.plugins.new.command import _target as parsed_target
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.plugins.new.result import NewScenario
from ffsm_drake.plugins.new.tuning import Tuning
from ffsm_drake.plugins.new.urdf.mounting import make_bus
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.plugins.new.urdf.target import cube, read_target
from ffsm_drake.plugins.new.urdf.writing import write_urdf
from ffsm_drake.scenario import load_scenario, thruster_layouts, thrusters_of
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.craft import make_true_plant

BUS = link("bus", mass=200, inertia=(40, 35, 30))
SMALL = link(
    "bus", mass=7, inertia=(0.1, 0.1, 0.1),
    extra='<visual><geometry><box size="0.3 0.3 0.3"/></geometry></visual>',
)  # fmt: skip
RANGE = 'lower="-1.5" upper="1.5" effort="40" velocity="1"'


def arm(
    *more: str, bus: str = BUS, limits: str = RANGE, length: float = 0.8, on: float = 0.6
) -> str:
    """A two-joint arm on a bus, with further parts."""
    return robot(
        bus,
        link("upper", mass=5, inertia=(0.3, 0.3, 0.02), com=(0, 0, 0.4 * length)),
        link("fore", mass=3, inertia=(0.1, 0.1, 0.01), com=(0, 0, 0.3 * length)),
        joint("shoulder", "bus", "upper", axis="0 1 0", xyz=f"0 0 {on}", limit=limits),
        joint("elbow", "upper", "fore", axis="1 0 0", xyz=f"0 0 {length}", limit=limits),
        link("tool"),
        joint("tip", "fore", "tool", kind="fixed", xyz=f"0 0 {length}"),
        *more,
    )


def written(folder: Path, text: str, name: str = "craft") -> Path:
    file = folder / f"{name}.urdf"
    file.write_text(text)
    return file


def made(folder: Path, text: str, **options: object) -> NewScenario:
    return new_scenario(written(folder, text), folder / "new", **options)  # type: ignore[arg-type]


SLIDES = (
    link("world"), link("x"), link("y"),
    joint("base_x", "world", "x", kind="prismatic", axis="1 0 0", limit=RANGE),
    joint("base_y", "x", "y", kind="prismatic", axis="0 1 0", limit=RANGE),
    joint("base_yaw", "y", "bus", kind="continuous"),
)  # fmt: skip
PLANAR = (link("world"), joint("slide", "world", "bus", kind="planar"))
TURNED = (joint("slide", "world", "bus", kind="planar", rpy="1.5707963267949 0 0"), link("world"))
UPRIGHT = (
    link("world"), link("x"), link("z"),
    joint("base_x", "world", "x", kind="prismatic", axis="1 0 0", limit=RANGE),
    joint("base_z", "x", "z", kind="prismatic", axis="0 0 1", limit=RANGE),
    joint("base_pitch", "z", "bus", kind="continuous", axis="0 -2 0"),
)  # fmt: skip
EARLY = (  # the turn first, about z of the world, which is x of the base
    link("world"), link("a"), link("b"),
    joint("base_yaw", "world", "a", kind="continuous", axis="0 0 1"),
    joint("base_x", "a", "b", kind="prismatic", axis="1 0 0", limit=RANGE),
    joint("base_y", "b", "bus", kind="prismatic", axis="1 0 0", rpy="0 1.5707963267949 0",
          limit=RANGE),
)  # fmt: skip
TILTED = (link("world"), joint("slide", "world", "bus", kind="planar", axis="0 1 1"))
FLOATING = (link("root"), joint("float", "root", "bus", kind="floating"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "normal"),
    [(SLIDES, 2), (PLANAR, 2), (TURNED, 2), (UPRIGHT, 1), (EARLY, 0), (TILTED, None),
     (FLOATING, None)],
)  # fmt: skip
def test_a_base_held_by_joints_becomes_free(
    tmp_path: Path, parts: tuple[str, ...], normal: int | None
) -> None:
    new = made(tmp_path, arm(*parts))
    assert new.servicer.base == "bus"
    assert [each.name for each in new.servicer.joints] == ["shoulder", "elbow"]
    assert new.servicer.normal == normal
    initial, harmonics = new.scenario.initial_posture, new.scenario.disturbance.harmonics
    for k, axis in enumerate("xyz"):
        assert (initial.base_position[k] == 0.0) == (k == normal)
        assert (f"base_position_{axis}" in harmonics) == (k != normal)
        within = normal is None or k == normal
        assert (initial.base_rpy[k] != 0.0) == within
        assert (f"base_rotation_{axis}" in harmonics) == within
    told = [each for each in new.remarks if "slides in a plane" in each]
    assert bool(told) == (parts is not FLOATING)
    assert any("not one of two axes" in each for each in told) == (parts is TILTED)


@pytest.mark.parametrize("seed", range(12))
def test_only_an_arm_is_mounted_on_a_bus(tmp_path: Path, seed: int) -> None:
    """A free base, also of links fixed to each other, is known by its mass."""
    rng = np.random.default_rng(seed)
    mass, share = rng.choice([4.0, 40.0, 2000.0]) * rng.uniform(0.3, 1.0), rng.choice([0.0, 0.6])
    parts = [(), SLIDES, PLANAR, FLOATING][seed % 4]
    pieces = ((1.0 - share) * mass, share * mass)
    own, box = (link(name, mass=m, inertia=3 * (m,))
                for name, m in zip(("bus", "box"), pieces, strict=True))  # fmt: skip
    more = (box, joint("screws", "bus", "box", kind="fixed")) if share else ()
    file = written(tmp_path, arm(*parts, *more, bus=own))
    if mass < 8.0 and not parts:  # the foot of an arm of 8 kg
        assert read_urdf(file, bus=make_bus(400.0)).base_mass == pytest.approx(400.0 + mass)
    elif mass >= 8.0:
        with pytest.raises(ModelError, match=r"has a free base, 'bus' with .* --bus-mass") as told:
            read_urdf(file, bus=make_bus(400.0))
        assert str(told.value).startswith(str(file))
        assert read_urdf(file).base_mass == pytest.approx(mass)


def test_a_sliding_base_of_its_own_mass_or_rotor_is_refused(tmp_path: Path) -> None:
    heavy = [*SLIDES]
    heavy[1] = link("x", mass=3)
    with pytest.raises(ModelError, match="attached to the world"):
        read_urdf(written(tmp_path, arm(*heavy)))
    rotor = (
        '<transmission name="t" xmlns:drake="http://drake.mit.edu"><joint name="base_x"/>'
        '<actuator name="a"><drake:rotor_inertia value="2"/></actuator></transmission>'
    )
    with pytest.raises(ModelError, match="joints base_x of the base have an armature"):
        read_urdf(written(tmp_path, arm(*SLIDES, rotor)))


@pytest.mark.long
def test_rotors_of_a_urdf_stay(tmp_path: Path) -> None:
    """Drake adds gear^2 times a rotor's inertia to the joint's."""
    rotor = (
        '<transmission name="t" xmlns:drake="http://drake.mit.edu">'
        '<type>transmission_interface/SimpleTransmission</type><joint name="elbow"/>'
        '<actuator name="a"><drake:rotor_inertia value="0.01"/><drake:gear_ratio value="10"/>'
        "</actuator></transmission>"
    )
    plants = []
    for k, more in enumerate([(), (rotor,)]):
        (tmp_path / str(k)).mkdir()
        new = made(tmp_path / str(k), arm(*more))
        plants.append(make_true_plant(load_scenario(new.scenario_file)))
    light, heavy = (each.plant.CalcMassMatrix(each.context) for each in plants)
    extra = np.zeros_like(light)
    extra[-1, -1] = 1.0
    assert heavy - light == pytest.approx(extra)


def test_all_faults_of_a_file_in_one_message(tmp_path: Path) -> None:
    text = arm(
        link("a", mass=1, inertia=(0.1, 0.1, 1.0)),
        link("b"),
        joint("a_to_b", "a", "b", limit='lower="1" upper="-1"'),
        joint("all", "bus", "a", limit=TURN),
        joint("ball", "bus", "c", kind="spherical"),
        '<frame name="tool" link="nowhere" xyz="0 0 0" rpy="0 0 0"/>',
    )
    with pytest.raises(ModelError) as error:
        read_urdf(written(tmp_path, text))
    for fault in (
        "link 'a': no body has the principal moments",
        "joint 'a_to_b': its lower limit 1 lies above its upper limit -1",
        "joint 'all': the name clashes",
        "its child link 'c' does not exist",
        "frame 'tool': its link 'nowhere' does not exist",
    ):
        assert fault in str(error.value)
    numbers = arm().replace('mass value="5"', 'mass value="x"').replace('lower="-1.5"', 'lower=""')
    with pytest.raises(ModelError, match=r"3 faults: \(1\) link 'upper'.*\(3\) joint 'elbow'"):
        read_urdf(written(tmp_path, numbers))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ('lower="0" upper="0" effort="0" velocity="0"', "limits of 0 say nothing and do not limit: "
         "effort of shoulder, elbow; velocity of shoulder, elbow; range of shoulder, elbow"),
        ('lower="-2" upper="2" effort="0"', "do not limit: effort of shoulder, elbow"),
        ('lower="-150" upper="150" velocity="60"', "perhaps in degrees, where a URDF has radians"),
    ],
)  # fmt: skip
def test_limits_that_say_nothing_are_named(tmp_path: Path, limits: str, told: str) -> None:
    new = made(tmp_path, arm(limits=limits))
    assert told in " ".join(new.remarks)
    assert not [each for each in new.remarks if "overlap" in each]
    with pytest.raises(ModelError, match="its limits leave it no motion; make it fixed"):
        read_urdf(written(tmp_path, arm(limits='lower="0.3" upper="0.3"')))


@pytest.mark.long
def test_fingers(tmp_path: Path) -> None:
    """A finger that rests at a limit is moved into its range; one that follows it is fixed."""
    finger = 'lower="0" upper="0.05" effort="5" velocity="0.1"'
    follow = '<mimic joint="left" multiplier="-1"/>'
    new = made(
        tmp_path,
        arm(
            link("l", mass=0.1, inertia=(1e-4, 1e-4, 1e-4)),
            link("r", mass=0.1, inertia=(1e-4, 1e-4, 1e-4)),
            joint("left", "fore", "l", kind="prismatic", axis="0 1 0", limit=finger, xyz="0 0 0.7"),
            joint("right", "fore", "r", kind="prismatic", axis="0 1 0", extra=follow,
                  xyz="0 0 0.7", limit='lower="-0.05" upper="0" effort="5" velocity="0.1"'),
        ),
    )  # fmt: skip
    assert [each.name for each in new.servicer.joints] == ["shoulder", "elbow", "left"]
    assert new.servicer.tip.frame == "tool"
    assert new.scenario.initial_posture.joints["left"] == pytest.approx(0.005)
    copy = (tmp_path / "new/craft.urdf").read_text()
    right = re.search(r'<joint name="right" type="fixed">.*?</joint>', copy, re.DOTALL)
    assert right is not None
    assert 'xyz="0.0 -0.00500' in right[0]
    result = CliRunner().invoke(main, ["validate", str(new.scenario_file), "--json"])
    assert '"warnings": []' in result.output
    leading = joint("r", "fore", "l", extra='<mimic joint="elbow"/>')
    with pytest.raises(ModelError, match="follows 'elbow' \\(<mimic>\\), which moves the tip"):
        read_urdf(written(tmp_path, arm(link("l", mass=1), leading)))


@pytest.mark.slow
def test_a_target_of_welded_links_is_one_body(tmp_path: Path) -> None:
    frame = '<frame name="grasp" link="body" xyz="0 0 -0.5" rpy="0 0 0"/>'
    parts = (
        link("body", mass=50, inertia=(5, 5, 5)),
        link("panel", mass=2, inertia=(0.5, 0.1, 0.6)),
        joint("weld", "body", "panel", kind="fixed", xyz="0 1 0", rpy="0 0 1.5707963267948966"),
    )
    target = read_target(written(tmp_path, robot(*parts, frame), "client"))
    assert (target.body, target.mass) == ("body", 52.0)
    assert target.center_of_mass == pytest.approx((0.0, 2.0 / 52.0, 0.0))
    shift = 50.0 * 2.0 / 52.0  # reduced mass, at 1 m
    assert target.inertia == pytest.approx((5.1 + shift, 5.5, 5.6 + shift, 0, 0, 0))
    new = made(tmp_path, arm(), target=tmp_path / "client.urdf")
    plant = make_true_plant(load_scenario(new.scenario_file))
    assert plant.plant.CalcTotalMass(plant.context) == pytest.approx(208.0 + 52.0)
    with pytest.raises(ModelError) as error:
        read_target(written(tmp_path, robot(*parts, joint("x", "body", "c")), "client"))
    assert "joint 'x' moves" in str(error.value)
    assert "no frame where it could be held" in str(error.value)


@pytest.mark.parametrize(
    ("word", "reach", "mass", "size"),
    [(None, 2.0, 50.0, 0.794), ("20", 2.0, 20.0, 0.585), ("20kg", 2.0, 20.0, 0.585),
     ("20kg,0.3m", 2.0, 20.0, 0.3), (None, 0.2, 8.0, 0.2)],
)  # fmt: skip
def test_mass_and_size_of_the_target(
    word: str | None, reach: float, mass: float, size: float
) -> None:
    """The last one is as long as the arm, with 1000 kg/m^3."""
    given = parsed_target(word)[:2] if word else (None, None)
    servicer = types.SimpleNamespace(base_mass=200.0, reach=reach)
    found = cube(*given, servicer, share=0.25)  # type: ignore[arg-type]
    assert (found.mass, found.side) == (mass, size)
    assert found.root.find("link/visual/geometry/box").get("size") == " ".join(3 * [str(size)])  # type: ignore[union-attr]


CROWDED = (
    link("wall", mass=1, extra='<visual><geometry><box size="3 3 0.1"/></geometry></visual>'),
    joint("stand", "bus", "wall", kind="fixed", xyz="0 0 2.45"),
)


@pytest.mark.long
def test_the_advice_on_a_smaller_target_helps(tmp_path: Path) -> None:
    """The advice is a value that was tried; followed, it leaves no remark."""
    told = "".join(
        each
        for each in made(tmp_path, arm(*CROWDED), payload_mass=50.0, payload_size=2.0).remarks
        if "overlap" in each
    )
    found = re.search(r"--target (\d+)kg,([\d.]+)m keeps clear", told)
    assert found, told
    (tmp_path / "again").mkdir()
    again = made(
        tmp_path / "again",
        arm(*CROWDED),
        payload_mass=float(found[1]),
        payload_size=float(found[2]),
    )
    assert not [each for each in again.remarks if "overlap" in each]


@pytest.mark.long
def test_no_advice_where_none_helps(tmp_path: Path) -> None:
    block = '<visual><geometry><box size="2 2 2"/></geometry></visual>'
    bus = link("bus", mass=300, inertia=(120, 120, 120), extra=block)
    new = made(tmp_path, arm(bus=bus, length=0.1, on=0.2))
    (told,) = [each for each in new.remarks if "overlap" in each]
    assert "--target" not in told
    assert "bus and debris overlap" in told


@pytest.mark.slow
def test_an_invented_base_does_not_count_for_clearances(tmp_path: Path) -> None:
    flat = link("bus", mass=200, inertia=(400, 400, 790))  # as a box: 6.9 m wide
    new = made(tmp_path, arm(bus=flat))
    assert any("not counted for clearances: bus" in each for each in new.remarks)
    model = load_scenario(new.scenario_file).model
    for invented in (False, True):
        pairs = Clearance(model, invented=invented).pairs
        assert ("bus" in {body.name() for pair in pairs for body in pair}) is invented


@pytest.mark.long
@pytest.mark.parametrize("thrusters", ["12", "12x0.1N"])
def test_a_small_base_gets_small_actuators(tmp_path: Path, thrusters: str) -> None:
    asked = Asked.parsed(thrusters=thrusters, wheels="3", sensors="flight")
    new = made(tmp_path, arm(bus=SMALL, length=0.1, on=0.16), asked=asked)
    units = new.scenario.actuation.thrusters.units.values()
    assert {each.force for each in units} == {0.0875 if thrusters == "12" else 0.1}
    assert max(max(map(abs, each.position)) for each in units) < 0.2
    wheel = new.scenario.actuation.wheels.units["wheel_1"]
    assert wheel.inertia == pytest.approx(0.005 * 0.1)
    assert wheel.torque_limit < 0.05


def test_wheels_by_data_sheet() -> None:
    found = Asked.parsed(wheels="3x0.02Nm,0.5Nms,6000rpm").wheels
    assert found == WheelData(3, 0.02, 0.5, 6000.0)
    (first, *_) = found.units(1.0, None).values()
    assert (first["torque_limit"], first["speed_limit"]) == (0.02, 628.0)
    assert first["inertia"] * first["speed_limit"] == pytest.approx(0.5, rel=1e-2)


def test_wheels_larger_than_the_base_are_one_line(tmp_path: Path) -> None:
    with pytest.raises((ModelError, ScenarioError)) as error:
        made(
            tmp_path, arm(bus=SMALL, length=0.1, on=0.16),
            asked=Asked.parsed(wheels="3x0.02Nm,200Nms", sensors="flight"),
        )  # fmt: skip
    assert "give smaller wheels" in str(error.value)
    assert len(str(error.value)) < 300


@pytest.mark.slow
def test_long_names_stand_apart(tmp_path: Path) -> None:
    long = "a_joint_with_a_name_that_is_longer_than_the_column"
    text = arm().replace('"elbow"', f'"{long}"')
    assert f"{long}  revolute" in made(tmp_path, text).summary()


def test_a_text_stl_is_drawn(tmp_path: Path) -> None:
    """The same corners become one. test_picture_poses.py draws binary files."""
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    lines = ["vertex {} {} {}".format(*corners[k]) for face in faces for k in face]
    visual = '<visual><geometry><mesh filename="a.stl"/></geometry></visual>'
    file = written(tmp_path, arm(bus=link("bus", mass=200, extra=visual)))
    remarks = list[str]()
    for content in ("\n".join(lines), "nothing"):
        (tmp_path / "a.stl").write_text(f"solid a\n{content}")
        remarks += write_urdf(read_urdf(file), tmp_path / "out", file_name="a.urdf", packages={})
    drawn = (tmp_path / "out/meshes/1/a.stl.obj").read_text().splitlines()
    assert sorted(drawn[:4]) == ["v 0 0 0", "v 0 0 1", "v 0 1 0", "v 1 0 0"]
    assert len(drawn) == 8
    assert " ".join(remarks).count("of an undrawable format") == 1


def box_at(middle: np.ndarray, sides: np.ndarray) -> str:
    place, size = (" ".join(map(str, each)) for each in (middle, sides))
    return f'<visual><origin xyz="{place}"/><geometry><box size="{size}"/></geometry></visual>'


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_thrusters_and_panels_are_on_the_box_of_the_base(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """A base of any size, place and mass: hardware is on its faces, or a line says on what."""
    rng = np.random.default_rng(seed)
    sides, middle = rng.uniform(0.3, 3.0, 3), rng.uniform(-0.3, 0.3, 3)
    density, word = rng.uniform(30.0, 400.0), str(rng.choice(["12", "12x5N", "16", "16x22N"]))
    count, covered, drawn = int(rng.integers(1, 5)), bool(rng.integers(2)), bool(rng.integers(2))
    if seed == 0:  # covered by its own panels, and a tank on top
        sides, middle, density = np.array([0.7, 0.7, 0.8]), np.zeros(3), 300.0
        word, count, covered, drawn = "12x5N", 2, True, True
    mass, half, up = density * float(sides.prod()), 0.5 * sides, np.array([0.0, 0.0, 1.0])
    out = np.array([0.0, half[1] + 1.0, 0.0])
    own = [
        (middle + out, np.array([0.2 * sides[0], 2.0, 0.02])),
        (middle - out, np.array([0.2 * sides[0], 2.0, 0.02])),
        (middle + up * (half[2] + 0.15), np.array([0.9 * sides[0], 0.9 * sides[1], 0.3])),
    ]
    covered = covered and drawn and all(each.prod() < 0.4 * sides.prod() for _, each in own)
    pictures = [(middle, sides)] * drawn + own * covered
    bus = link(
        "bus",
        mass=mass,
        inertia=tuple(mass / 12.0 * (sides @ sides - sides**2)),
        com=tuple(middle),
        extra="".join(itertools.starmap(box_at, pictures)),
    )
    asked = Asked.parsed(thrusters=word, panels=f"{count}x{0.05 * mass:.6f}kg", driven="all")
    monkeypatch.setattr(approach, "_SAMPLES", 4)
    monkeypatch.setattr(Tuning, "tune", lambda self: None)  # gains play no part
    text = arm(bus=bus, length=4.0, on=middle[2] + half[2] + 0.6)
    try:
        new = made(tmp_path, text, asked=asked)
    except ModelError as error:  # of a small or flat base the shortest panels leave no body
        if "make the parts lighter or shorter" not in str(error):
            raise
        return
    slack = 0.02 * (sides.max() + np.abs(middle).max())
    units = list(thrusters_of(new.scenario.actuation.thrusters).values())
    assert len(units) == int(word[:2])
    for unit in units:
        at = np.abs(unit.position - middle)
        assert (at <= half + slack).all()
        assert at[2] == pytest.approx(half[2], abs=slack)
        assert (at[:2] > 0.6 * half[:2] - slack).all()
    arms = np.array([np.cross(u.position - middle, u.direction) for u in units])
    assert np.abs(arms).max() < np.linalg.norm(half) + slack
    if "N" in word:
        same = thruster_layouts()[word]
        assert [each.force for each in units] == [each.force for each in same.values()]
    panels = list(new.scenario.model.flexible.values())
    assert len(panels) == count
    for panel in panels:
        root = middle + half * panel.direction
        assert np.array(panel.position) == pytest.approx(root, abs=slack)
    told = " ".join(new.remarks)
    for k in range(4):
        assert (f"panel_{k + 1} lies on a part of 'bus'" in told) == (covered and k < min(count, 2))
    assert ("are inside a part of 'bus'" in told) == covered


def test_the_layout_of_the_shipped_servicer_fits_it(tmp_path: Path) -> None:
    """The layout of its size stays a name; it is scaled for a base that is a little larger."""
    model = load_scenario("paper").model
    for scale, more in ((1.0, {}), (1.1, {"box": [1.32, 1.32, 2.09]})):
        box = BaseBox.of(model, ["base"], "base", side=9.0)
        box = dataclasses.replace(box, half=scale * box.half)
        found = Asked.parsed(thrusters="12x5N").thruster_settings(400.0, box)
        assert found == {"layout": "12x5N", **more}
