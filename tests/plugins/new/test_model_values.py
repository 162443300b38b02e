"""Masses, inertias and limits of model files: drawn files, compared with Drake and MuJoCo."""

import itertools
import logging
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mass_matrices import by_drake, by_mujoco, plant_of
from scipy.spatial.transform import Rotation

from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.new.urdf.formats.direct import check_direct
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.plugins.new.urdf.writing import write_urdf
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.inertia import MOMENTS, SIX
from ffsm_drake.spacecraft.plant import make_plant

DRAWS = [6, pytest.param(500, marks=pytest.mark.exhaustive)]
INERTIAL = (
    "<inertial><mass>8</mass><inertia><ixx>0.5</ixx><iyy>0.4</iyy><izz>0.2</izz></inertia>"
    "</inertial>"
)

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def numbers(values: object) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


# libsdformat's automatic inertia


def shapes(rng: np.random.Generator, mesh: Path) -> Iterator[str]:
    """Collision shapes of a link, with poses and densities."""
    for k in range(rng.integers(1, 4)):
        a, b, c = rng.uniform(0.05, 0.9, 3).tolist()
        geometry = rng.choice([
            f"<box><size>{a} {b} {c}</size></box>", f"<sphere><radius>{a}</radius></sphere>",
            f"<cylinder><radius>{a}</radius><length>{b}</length></cylinder>",
            f"<capsule><radius>{a}</radius><length>{b}</length></capsule>",
            f"<ellipsoid><radii>{a} {b} {c}</radii></ellipsoid>",
            f"<cone><radius>{a}</radius><length>{b}</length></cone>",
            f"<mesh><uri>{mesh.name}</uri><scale>{a} {b} {c}</scale></mesh>",
        ])  # fmt: skip
        density = f"<density>{rng.uniform(5, 900)}</density>" * bool(rng.random() < 0.5)
        surface = "<surface><friction><ode><mu>3</mu></ode></friction></surface>"
        yield (
            f'<collision name="c{k}"><pose>{numbers(rng.normal(size=6))}</pose><geometry>'
            f"{geometry}</geometry>{density}{surface * bool(rng.random() < 0.3)}</collision>"
        )


@pytest.mark.parametrize(
    "draws",
    [pytest.param(6, marks=pytest.mark.slow), pytest.param(500, marks=pytest.mark.exhaustive)],
)
def test_automatic_inertia_is_drakes(draws: int, tmp_path: Path) -> None:
    mesh, file = tmp_path / "block.obj", tmp_path / "craft.sdf"
    mesh.write_text(TETRAHEDRON)
    rng, log = np.random.default_rng(21), logging.getLogger("drake")
    for draw in range(draws):
        inside = f"<density>{rng.uniform(5, 900)}</density>" * bool(rng.random() < 0.4)
        inside += f"<mass>{rng.uniform(5, 900)}</mass>" * bool(rng.random() < 0.3)
        text = (
            '<sdf version="1.11"><model name="craft"><link name="bus">'
            f'<inertial auto="{rng.choice(["true", "1"])}">{inside}</inertial>'
            f"{''.join(shapes(rng, mesh))}</link>"
            f'<link name="arm"><pose>0 0 1 0 0 0</pose>{INERTIAL}</link><joint name="j" '
            'type="revolute"><parent>bus</parent><child>arm</child><axis><xyz>0 1 0</xyz></axis>'
            "</joint></model></sdf>"
        )
        file.write_text(text)
        if rng.random() < 0.3:  # the same from an included file
            file.with_name("part.sdf").write_text(text)
            merge = 'merge="true"' * int(rng.integers(2))
            file.write_text(
                f'<sdf version="1.11"><model name="craft"><include {merge}><uri>part.sdf</uri>'
                "</include></model></sdf>"
            )
        alone = tmp_path / "alone.sdf"  # Drake does not find a relative mesh
        alone.write_text(text.replace(f"<uri>{mesh.name}", f"<uri>{mesh}"))
        log.disabled = True  # it warns of what libsdformat has used
        expected = by_drake(plant_of(alone), {"j": 0.4})
        log.disabled = False
        write_urdf(read_urdf(file), tmp_path, file_name="craft.urdf", packages={})
        found = by_drake(plant_of(tmp_path / "craft.urdf"), {"j": 0.4})
        np.testing.assert_allclose(
            found, expected, rtol=0.0, atol=1e-12 * expected.max(), err_msg=f"{draw}: {text}"
        )


# rounding in inertias


def drawn_inertia(rng: np.random.Generator, excess: float) -> tuple[np.ndarray, float]:
    """An inertia (3, 3) of a turned rod, plate or solid, kg m^2, and its largest moment. ``excess``
    is a violation of the triangle inequality, a share of that.
    """
    one, other = 10.0 ** rng.uniform(-6.0, 3.0, 2)
    low, middle = rng.choice([[0.0, one], [one, one], [min(one, other), max(one, other)]])
    high = low + middle
    if not excess:
        high *= rng.choice([1.0, rng.uniform(middle / high, 1.0)])
    turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    turn = turn if rng.random() < 0.7 else np.eye(3)
    moments = np.array([low, middle, high + excess * high])
    noise = rng.normal(size=(3, 3)) * high * rng.choice([0.0, 1e-17, 1e-15, 1e-13, 1e-12]) / 3.0
    inertia = (turn * moments) @ turn.T + noise
    return 0.5 * (inertia + inertia.T), moments.max()


def file_with(inertia: np.ndarray, place: str, kind: str) -> str:
    """A URDF or an SDF whose second link has an inertia."""
    six = dict(zip(MOMENTS, inertia[SIX].tolist(), strict=True))
    if kind == "sdf":
        tags = "".join(f"<{key}>{value!r}</{key}>" for key, value in six.items())
        return (
            f'<sdf version="1.9"><model name="craft"><link name="bus">{INERTIAL}</link>'
            f'<link name="arm"><inertial><pose>{place} 0 0 0</pose><mass>8</mass>'
            f'<inertia>{tags}</inertia></inertial></link><joint name="j" type="revolute"><parent>'
            "bus</parent><child>arm</child><axis><xyz>0 1 0</xyz></axis></joint></model></sdf>"
        )
    moments = " ".join(f'{key}="{value!r}"' for key, value in six.items())
    return (
        '<robot name="craft"><link name="bus"><inertial><mass value="8"/><inertia ixx="0.5" '
        'iyy="0.4" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="arm"><inertial>'
        f'<origin xyz="{place}"/><mass value="8"/><inertia {moments}/></inertial></link>'
        '<joint name="j" type="continuous"><parent link="bus"/><child link="arm"/>'
        '<axis xyz="0 1 0"/></joint></robot>'
    )


def hand_made(inertia: np.ndarray, center: np.ndarray) -> np.ndarray:
    """H of ``file_with`` at the joint's zero, from its definition: the sum of J^T M J."""
    result = np.zeros((7, 7))
    for mass, at, tensor, moves in (
        (8.0, np.zeros(3), np.diag([0.5, 0.4, 0.2]), 0.0), (8.0, center, inertia, 1.0),
    ):  # fmt: skip
        cross = np.cross(np.eye(3), at).T  # w x r = cross w
        axis = moves * np.array([0.0, 1.0, 0.0])
        angular = np.column_stack([np.eye(3), np.zeros((3, 3)), axis])
        linear = np.column_stack([cross, np.eye(3), np.cross(axis, at)])
        result += mass * linear.T @ linear + angular.T @ tensor @ angular
    return result


@pytest.mark.parametrize("kind", ["urdf", "sdf"])
@pytest.mark.parametrize("draws", [8, pytest.param(2000, marks=pytest.mark.exhaustive)])
def test_rounding_in_an_inertia_is_no_fault(draws: int, kind: str, tmp_path: Path) -> None:
    rng, file, written = np.random.default_rng(20), tmp_path / f"a.{kind}", tmp_path / "b.urdf"
    for draw in range(draws):
        center = rng.uniform(-1.0, 1.0, 3)
        inertia, _ = drawn_inertia(rng, 0.0)
        file.write_text(file_with(inertia, numbers(center), kind))
        write_urdf(read_urdf(file), tmp_path, file_name=written.name, packages={})
        expected = hand_made(inertia, center)
        np.testing.assert_allclose(
            by_drake(plant_of(written, strict=True), {"j": 0.0}), expected, rtol=0.0,
            atol=5e-12 * np.abs(expected).max(), err_msg=f"{draw}: {inertia.tolist()}",
        )  # fmt: skip


@pytest.mark.parametrize("kind", ["urdf", "sdf"])
@pytest.mark.parametrize("draws", [8, pytest.param(2000, marks=pytest.mark.exhaustive)])
def test_inertia_of_no_body_is_refused(draws: int, kind: str, tmp_path: Path) -> None:
    rng, file = np.random.default_rng(21), tmp_path / f"a.{kind}"
    for _ in range(draws):
        inertia, _ = drawn_inertia(rng, 10.0 ** rng.uniform(-8.5, 0.0))
        file.write_text(file_with(inertia, "0 0 0.4", kind))
        with pytest.raises(ModelError, match="link 'arm': no body") as error:
            read_urdf(file)
        assert "\n" not in str(error.value)


# efforts of MuJoCo's actuators

JOINTS = ("one", "two", "three")
FAR = 1e6  # control, position and rate where a force without a limit shows


def drawn_actuators(rng: np.random.Generator) -> str:
    """An MJCF with actuators of many kinds on its joints. Its armature keeps it where it is."""

    def draw(*values: float) -> float:
        return float(rng.choice(values)) * float(rng.uniform(0.5, 1.5))

    def range_of(name: str, share: float) -> str:
        if rng.random() > share:
            return ""
        low, high = -draw(1.0, 5.0), draw(1.0, 5.0)
        high = -low if rng.random() < 0.5 else high
        return f'{name}="{low} {high}" '

    pull = range_of("actuatorfrcrange", 0.5)  # corners of control are its extremes without more

    def actuator() -> str:
        tendon = rng.random() < 0.2
        forces = 0.0 if tendon and pull else 0.4
        where = 'tendon="t"' if tendon else f'joint="{rng.choice(JOINTS)}"'
        if not tendon and rng.random() < 0.1:
            where = where.replace("joint", "jointinparent")
        gear = 3.0 if tendon else draw(1.0, 10.0, -10.0)
        kind = rng.choice([
            "motor", f'position kp="{draw(10.0)}"', f'velocity kv="{draw(10.0)}"',
            f'general gainprm="{draw(2.0, -3.0)}"',
            f'general gainprm="{draw(2.0)}" biastype="affine" biasprm="{draw(0.1, -0.1)}"',
            f'general gaintype="affine" gainprm="{draw(2.0)}" dyntype="filter" dynprm="0.01"',
            f'general dyntype="filterexact" dynprm="0.01" {range_of("actrange", 0.7)}',
            f'general dyntype="integrator" {range_of("actrange", 1.0)}',
            f'general gaintype="affine" gainprm="1 0 {draw(2.0)}"',
        ])  # fmt: skip
        controls = 0.0 if "integrator" in kind else 0.7  # it reaches its range in one step
        return (
            f'<{kind} {where} gear="{gear}" group="{rng.integers(0, 4)}" '
            f"{range_of('ctrlrange', controls)}{range_of('forcerange', forces)}/>"
        )

    inertial = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>'
    tree = ""
    for name in reversed(JOINTS):
        hinge = rng.choice(["hinge", "slide"])
        tree = (
            f'<body pos="0 0 0.2">{inertial}<joint name="{name}" type="{hinge}" axis="0 1 0" '
            f'armature="1e12" {range_of("actuatorfrcrange", 0.3)}/>{tree}</body>'
        )
    option = '<option actuatorgroupdisable="3"/>' * bool(rng.random() < 0.3)
    levers = f'<joint joint="one" coef="{draw(1.0)}"/><joint joint="three" coef="{draw(-2.0)}"/>'
    return (
        f'<mujoco>{option}<worldbody><body name="bus"><freejoint/>{inertial}{tree}</body>'
        f'</worldbody><tendon><fixed name="t" {pull}>{levers}</fixed>'
        f"</tendon><actuator>{''.join(actuator() for _ in range(rng.integers(1, 5)))}</actuator>"
        "</mujoco>"
    )


def efforts_of(text: str) -> np.ndarray:
    """Least and greatest force (joint, 2) of the actuators, over corners of control and motion."""
    model = mujoco.MjModel.from_xml_string(text)
    data, found = mujoco.MjData(model), []
    model.opt.timestep = 0.005
    for corner in itertools.product((-FAR, FAR), repeat=model.nu):
        mujoco.mj_resetData(model, data)
        data.ctrl = corner
        for _ in range(80 if model.na else 0):  # forty time constants
            mujoco.mj_step(model, data)
        for speed in (-FAR, 0.0, FAR):
            data.qpos[7:] = data.qvel[6:] = speed
            mujoco.mj_forward(model, data)
            found.append(data.qfrc_actuator[6:].copy())
    result = np.column_stack([np.min(found, axis=0), np.max(found, axis=0)])
    bare = ~result.any(axis=1) & (model.jnt_actfrclimited[1:] > 0)  # the actuator may come later
    return np.where(bare[:, None], model.jnt_actfrcrange[1:], result)


@pytest.mark.parametrize("draws", [10, pytest.param(1000, marks=pytest.mark.exhaustive)])
def test_efforts_are_mujocos(draws: int, tmp_path: Path) -> None:
    rng, file = np.random.default_rng(14), tmp_path / "craft.xml"
    for draw in range(draws):
        text = drawn_actuators(rng)
        file.write_text(text)
        expected = efforts_of(text)
        expected[np.abs(expected) > 1e3] *= np.inf
        driven = expected.any(axis=1)
        one_way = driven & ((expected[:, 0] >= 0.0) | (expected[:, 1] <= 0.0))
        if one_way.any():
            with pytest.raises(ModelError, match="push one way only"):
                read_urdf(file)
            continue
        servicer = read_urdf(file)
        smaller = np.where(driven, np.abs(expected).min(axis=1), np.inf)
        found = [joint.effort for joint in servicer.joints]
        np.testing.assert_allclose(found, smaller, rtol=1e-9, err_msg=f"{draw}: {text}")
        uneven = expected[:, 0] < -expected[:, 1] * (1.0 + 1e-9)
        uneven |= expected[:, 1] > -expected[:, 0] * (1.0 + 1e-9)
        told = " ".join(each for each in servicer.remarks if "in both directions" in each)
        assert [name in told for name in JOINTS] == uneven.tolist(), f"{draw}: {text}"


# MJCF and SDFormat that enter through model directives


def drawn_mjcf(rng: np.random.Generator) -> str:
    """An arm in MJCF; each property of a list is there or not."""

    def some(text: str, share: float = 0.15) -> str:
        return text * bool(rng.random() < share)

    tree = ""
    for name in reversed(JOINTS):
        kind = rng.choice(["hinge", "slide"])
        joint = (
            f'<joint name="{name}" type="{kind}" axis="{numbers(rng.normal(size=3))}" '
            + some('armature="0.7" ') + some('damping="0.3" ') + some('range="-1 2" ')
            + some('class="heavy" ') + some('pos="0 0.1 0.1" ') + some('ref="0.2" ', 0.05)
            + some('stiffness="3" ', 0.05) + some('frictionloss="2" ', 0.05) + "/>"
        )  # fmt: skip
        shape = '<geom type="box" size="0.1 0.2 0.3" ' + some('mass="2" ', 0.3) + "/>"
        inertial = (
            f'<inertial pos="{numbers(rng.normal(size=3))}" mass="3" '
            f'euler="{numbers(rng.normal(size=3))}" diaginertia="0.3 0.2 0.25"/>'
        )
        more = some('<replicate count="2" offset="1 0 0"><geom size="0.1"/></replicate>', 0.1)
        tree = (
            f'<body name="link_{name}" pos="0 0 0.4" euler="{numbers(rng.normal(size=3))}">'
            f"{shape if rng.random() < 0.4 else inertial}{more}{joint}{tree}</body>"
        )
    compiler = '<compiler angle="radian" ' + some('eulerseq="ZYX" ')
    compiler += some('inertiafromgeom="true" ', 0.1) + some('autolimits="false" ', 0.05) + "/>"
    default = '<default><default class="heavy"><joint armature="0.4"/></default>'
    default += some('<geom density="300"/>') + some('<joint armature="0.2"/>', 0.1) + "</default>"
    drive = some('<actuator><motor joint="one" gear="5" ctrlrange="-1 1"/></actuator>')
    drive += some('<actuator><motor joint="two"/></actuator>')
    tie = some('<equality><joint joint1="one" joint2="two"/></equality>', 0.05)
    return (
        f'<mujoco model="craft">{compiler}{default}<worldbody><body name="bus"><freejoint/>'
        '<inertial pos="0 0 0.1" mass="20" diaginertia="3 2 4"/><geom size="0.3"/>'
        f"{tree}</body></worldbody>{drive}{tie}</mujoco>"
    )


def readings(text: str) -> Iterator[np.ndarray]:
    """H and the joints' ranges, by MuJoCo and by Drake alone."""
    model, joints = mujoco.MjModel.from_xml_string(text), {"one": 0.3, "two": -0.2, "three": 0.5}
    ranges = np.where(
        model.jnt_limited[1:, None] > 0, model.jnt_range[1:] - model.qpos0[7:, None], [-9.0, 9.0]
    )
    yield np.concatenate([by_mujoco(text, joints).ravel(), ranges.ravel()])
    logging.getLogger("drake").disabled = True
    plant = plant_of(text, "xml")
    logging.getLogger("drake").disabled = False
    moved = map(plant.GetJointByName, JOINTS)
    ranges = [[*each.position_lower_limits(), *each.position_upper_limits()] for each in moved]
    yield np.concatenate([by_drake(plant, joints).ravel(), np.clip(ranges, -9.0, 9.0).ravel()])


@pytest.mark.parametrize("draws", [12, pytest.param(1000, marks=pytest.mark.exhaustive)])
def test_what_drake_would_drop_is_refused(draws: int, tmp_path: Path) -> None:
    """Refused is what Drake reads otherwise than MuJoCo, and nothing else."""
    rng, file, passed = np.random.default_rng(13), tmp_path / "craft.xml", 0
    for draw in range(draws):
        text = drawn_mjcf(rng)
        file.write_text(text)
        dropped = ("stiffness=", "frictionloss=", "<equality>", "<motor")
        told = ""
        try:
            check_direct(str(file), {})
            passed += 1
        except ModelError as error:
            told = str(error)
            assert "\n" not in told
            assert told.startswith("craft.xml: ")
        unclear = "autolimits=" in text and " range=" in text  # MuJoCo: none; Drake: an error
        if unclear or any(each in text for each in dropped):
            # without an effect of its own: a motor without gear, limits and armature
            assert told or ("<motor" in text and "gear" not in text), text
            continue
        wanted, read = readings(text)
        differs = not np.allclose(wanted, read, rtol=0.0, atol=1e-8 * np.abs(wanted).max())
        assert bool(told) == differs, f"{draw}: {told} {text}"
    assert passed


@pytest.mark.parametrize(
    "way",
    [
        pytest.param("directives", marks=pytest.mark.slow),
        pytest.param("servicer", marks=pytest.mark.long),
    ],
)
def test_armature_is_not_lost_by_any_way_in(way: str, tmp_path: Path) -> None:
    text = '<mujoco model="servicer"><worldbody><body name="bus"><freejoint/>{}</body></worldbody>'
    arm = '<body name="arm"><joint name="j" armature="1"/><geom size="0.2"/></body>'
    (tmp_path / "craft.xml").write_text(text.format(f'<geom size="1"/>{arm}') + "</mujoco>")
    directives = tmp_path / "craft.dmd.yaml"
    directives.write_text(
        "directives:\n- add_model: {name: servicer, file: package://here/craft.xml}\n"
    )
    given = {"directives": str(directives)} if way == "directives" else {
        "directives": None, "servicer": str(tmp_path / "craft.xml"),
        "debris": "package://ffsm_drake/urdf/debris.urdf", "grasp": "debris::grasp",
    }  # fmt: skip
    model = Model(packages={"here": str(tmp_path)}, end_effector="servicer::arm", **given)
    with pytest.raises(ModelError) as error:
        make_plant(model)
    for part in (f"model.{way}", "craft.xml", "joint 'j' without 1 kg m^2", "ffsm new NAME --mod"):
        assert part in str(error.value)


@pytest.mark.slow
def test_limits_of_a_file_in_directives_hold(tmp_path: Path) -> None:
    """The plant gives those of other formats than URDF."""
    joint = '<joint name="j" range="-1 2"/><geom size="0.2"/>'
    (tmp_path / "craft.xml").write_text(
        '<mujoco model="craft"><compiler angle="radian"/><worldbody><body name="bus"><freejoint/>'
        f'<geom size="1"/><body name="arm">{joint}</body></body></worldbody><actuator><motor '
        'joint="j" ctrlrange="-4 4"/></actuator></mujoco>'
    )
    model = Model(directives=str(tmp_path / "craft.xml"), end_effector="craft::arm")
    position, _, force = Craft(Scenario(model=model)).limits
    assert [each[-1] for each in (*position.joints, *force.joints)] == [-1.0, 2.0, -4.0, 4.0]
