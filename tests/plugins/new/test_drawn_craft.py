"""Captures with drawn spacecraft: the plan keeps the joints' limits, and a failing mission has a
remedy that works. ``FFSM_DRAWS=40 pytest -m exhaustive`` on this file tries as many.
"""

import os
import re
import shlex

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from drawn_craft import drawn_craft
from outside_urdfs import joint, link, robot, simple_arm

from ffsm_drake.cli import main
from ffsm_drake.common.numbers import rounded_up
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.verdict import Verdict
from ffsm_drake.plugins.new import result
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.scenario import load_scenario, scenario_to_dict
from ffsm_drake.spacecraft.craft import Craft, make_true_plant
from ffsm_drake.systems.reference import make_motion

DRAWS = int(os.environ.get("FFSM_DRAWS", "20"))


def typed(*words):
    """The exit code and the lines of ``ffsm new``."""
    result = CliRunner().invoke(main, ["new", *map(str, words)])
    return result.exit_code, result.output.splitlines()


def remedied(words, line):
    """Options with the change that a last line names."""
    told = line.removeprefix("what helps: ").partition(": with it")[0]
    if told.startswith("leave out"):
        at = words.index(told.split()[-1])
        return [*words[:at], *words[at + 2 :]]
    option, value = shlex.split(told.removeprefix("give "))
    at = words.index(option) if option in words else len(words)
    return [*words[:at], option, value, *words[at + 2 :]]


def used(scenario):
    """The largest shares of the limits of position and rate along the planned motion."""
    model = make_true_plant(scenario)
    rows = make_motion(make_mission(scenario)).rows(np.linspace(0.0, scenario.duration, 801))
    nq, nv = len(model.coordinates.position_names), len(model.coordinates.names)
    q, v, _ = np.split(rows, [nq, nq + nv], axis=1)
    position, rate, _ = Craft(scenario).limits
    return position.used(q[:, 1:]).max(), rate.used(v).max()


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(DRAWS))
def test_a_drawn_mission_goes_as_planned_or_has_a_remedy(tmp_path, seed):
    urdf, options = drawn_craft(seed)
    (tmp_path / "craft.urdf").write_text(urdf)
    words = [part for key, word in options.items() for part in (f"--{key}", word)]
    code, lines = typed(tmp_path / "new", "--urdf", tmp_path / "craft.urdf", *words)
    if code == 0:
        assert max(used(load_scenario(tmp_path / "new" / "new.yaml"))) <= 1.0
        return
    assert code == 3, lines[-1]
    again = remedied(words, lines[-1])
    code, lines = typed(tmp_path / "again", "--urdf", tmp_path / "craft.urdf", *again)
    assert code == 0, lines[-1]


@pytest.mark.long
def test_a_failing_mission_names_what_helps_and_typing_it_does(tmp_path, monkeypatch):
    def verdict(scenario, **_):
        planned = ("too heavy",) if scenario.payload.truth.mass > 20.0 else ()
        return Verdict(
            linear=None, not_linear="", load=None, noises=None, run=None, planned=planned
        )

    monkeypatch.setattr(result, "verdict", verdict)
    (tmp_path / "arm.urdf").write_text(simple_arm())
    words = ["--urdf", tmp_path / "arm.urdf", "--target", "40"]
    code, lines = typed(tmp_path / "heavy", *words)
    assert code == 3
    assert lines[-1] == (
        "what helps: give --target 16kg: with it, the mission is expected to go as planned"
    )
    code, lines = typed(tmp_path / "light", *remedied(words, lines[-1]))
    assert code == 0
    assert not lines[-1].startswith("what helps")


FORK = """<mujoco><worldbody><body name="bus"><freejoint/>
<geom type="box" size="0.5 0.4 0.45" mass="120"/>
<body name="stem" pos="0 0 0.45"><joint name="s1" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.05" mass="5"/>
<body name="left" pos="0 0 0.6"><joint name="l1" axis="0 1 0" range="10 90"/>
<geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="2"/>
<site name="tool" pos="0 0 0.35"/></body>
<body name="right" pos="0 0 0.6"><joint name="r1" axis="0 1 0" range="-90 -10"/>
<geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="2"/></body>
</body></body></worldbody></mujoco>"""


def test_frames_that_could_hold_the_target_in_place_of_the_tip(tmp_path):
    (tmp_path / "fork.xml").write_text(FORK)
    servicer = read_urdf(tmp_path / "fork.xml")
    assert servicer.tip.frame == "tool"  # the only frame that is named
    assert servicer.other_frames == ["right", "left"]
    (tmp_path / "gripper.xml").write_text(FORK.replace('<site name="tool" pos="0 0 0.35"/>', ""))
    servicer = read_urdf(tmp_path / "gripper.xml")
    assert servicer.tip.frame == "stem"
    assert servicer.other_frames == ["left", "right"]
    (tmp_path / "arm.urdf").write_text(simple_arm())
    assert read_urdf(tmp_path / "arm.urdf").other_frames == []


@pytest.mark.long
def test_a_fork_whose_mission_fails_is_told_of_a_tip_that_helps(tmp_path):
    (tmp_path / "fork.xml").write_text(FORK)
    words = ["--urdf", tmp_path / "fork.xml"]
    code, lines = typed(tmp_path / "stem", *words)
    assert code == 3
    assert lines[-1].startswith("what helps: give --tip tool: with it")
    assert typed(tmp_path / "tool", *remedied(words, lines[-1]))[0] == 0


def test_less_is_asked_by_one_option_at_a_time():
    words = {"thrusters": "16x2N", "wheels": "4x0.5Nm", "panels": "2x3kg", "capture": "4deg/s"}
    found = dict(Asked.parsed(**words).milder())
    assert list(found) == [
        "give --thrusters 16",
        "give --wheels 4",
        "give --capture 2deg/s",
        "give --capture 0.8deg/s",
        "leave out --panels",
    ]
    for told, asked in found.items():
        change = [part for key, word in words.items() for part in (f"--{key}", word)]
        again = remedied(change, f"what helps: {told}: with it")
        pairs = zip(again[::2], again[1::2], strict=True)
        assert asked == Asked.parsed(**{key[2:]: word for key, word in pairs})


def numbers(data):
    """The numbers of a scenario's file that are not from a model file."""
    if isinstance(data, dict):
        own = {"payload", "limit", "coulomb_friction", "viscous_friction"}
        yield from (x for key, each in data.items() if key not in own for x in numbers(each))
    elif isinstance(data, list):
        yield from (x for each in data for x in numbers(each))
    elif isinstance(data, float):
        yield data


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(int(os.environ.get("FFSM_DRAWS", "1"))))
def test_numbers_in_the_file_have_six_digits_at_most(tmp_path, seed):
    """With joints whose limits have many digits. The scenario of the file is the one checked."""
    urdf, options = drawn_craft(seed)
    draw = np.random.default_rng(seed)
    limits = re.compile(r'(lower|upper)="([-\d.]+)"')
    urdf = limits.sub(lambda m: f'{m[1]}="{float(m[2]) * draw.uniform(0.9, 1.0)}"', urdf)
    finger = joint("finger", "tool", "pad", kind="prismatic", axis="1 0 0",
                   limit='lower="0.0049999999999999999" upper="0.05" effort="1" velocity="1"',
                   )  # fmt: skip
    urdf = urdf.replace("</robot>", f"{finger}{link('pad', mass=0.1)}</robot>")
    (tmp_path / "craft.urdf").write_text(urdf)
    mass = float(options.pop("target"))
    del options["capture"]  # whose posture takes long to find
    made = new_scenario(tmp_path / "craft.urdf", tmp_path / "new", tip="tool", payload_mass=mass,
                        asked=Asked.parsed(**options))  # fmt: skip
    found = [*numbers(yaml.safe_load(made.scenario_file.read_text()))]
    assert len(found) > 50
    assert [x for x in found if float(f"{x:.6g}") != x] == []
    written = scenario_to_dict(load_scenario(made.scenario_file))
    checked = scenario_to_dict(made.scenario)
    differing = {key for key in written | checked if written.get(key) != checked.get(key)}
    assert differing <= {"model"}  # whose paths are absolute


@pytest.mark.slow
def test_a_flat_target_can_be_held(tmp_path):
    """Its largest moment is the sum of the others, which rounding must not exceed."""
    (tmp_path / "plate.urdf").write_text(
        robot(link("plate", mass=5, inertia=(5 / 12, 5 / 12, 5 / 6)),
              '<frame name="grasp" link="plate" xyz="0 0 -0.1" rpy="0 0 0"/>')
    )  # fmt: skip
    (tmp_path / "arm.urdf").write_text(simple_arm())
    made = new_scenario(tmp_path / "arm.urdf", tmp_path / "new", target=tmp_path / "plate.urdf")
    assert load_scenario(made.scenario_file).payload.truth.inertia[:3] == pytest.approx(
        [5 / 12, 5 / 12, 5 / 6], rel=1e-12
    )


def test_bounds_are_rounded_up():
    random = np.random.default_rng(0)
    for value in [0.0204, 1.0, 100.0, 0.0, *10.0 ** random.uniform(-12.0, 12.0, 500)]:
        for digits in (2, 3):
            found = rounded_up(value, digits)
            assert value * (1.0 - 1e-8) <= found <= value * (1.0 + 10.0 ** (1 - digits))
            assert float(f"{found:.{digits - 1}e}") == pytest.approx(found, rel=1e-9)
