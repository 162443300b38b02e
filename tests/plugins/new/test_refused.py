"""Files and options that ``ffsm new`` refuses in one line, before it writes anything."""

import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner
from outside_urdfs import (
    BOX,
    TURN,
    arm_alone,
    gripper,
    joint,
    link,
    robot,
    simple_arm,
    stage,
    two_hands,
)

from ffsm_drake.cli import main

FILES = {
    "arm": simple_arm(),
    "lamp": simple_arm(link("lamp", mass=1, inertia=(0, 0, 0)),
                       joint("pan", "bus", "lamp", limit=TURN)),
    "shape": simple_arm(
        link("tag", extra="<visual><geometry><box/></geometry></visual>"),
        joint("t", "bus", "tag", kind="fixed"),
    ),
    "planar": simple_arm().replace('"revolute"', '"planar"'),
    "alone": arm_alone(),
    "feet": robot(link("a", **BOX), link("b", **BOX)),
    "beside": arm_alone().replace("</robot>", link("b", **BOX) + "</robot>"),
    "box": robot(link("a", **BOX)),
    "bare": stage(frame=""),
    "gripper": gripper(),
    "hands": two_hands("zyyxyx"),
    "held": robot(link("box", mass=30, inertia=(1, 1, 1)),
                  '<frame name="grasp" link="box" xyz="-0.2 0 0" rpy="0 1.57 0"/>'),
}  # fmt: skip
TIPS = "--urdf hands.urdf --tips"
REFUSED = {  # options -> what is told
    "--urdf lamp.urdf": "joint 'pan' moves a negligible inertia",
    "--urdf shape.urdf": "shape.urdf: Missing box attribute: size",
    "--urdf planar.urdf": "prismatic or fixed, not 'planar'",
    "--urdf none.urdf": "none.urdf: no such file",
    "--urdf .": "is a folder; give the URDF of base and arm",
    "--urdf arm.urdf --payload-mass -1": "must be > 0 kg, not -1",
    "--urdf arm.urdf --package a=/nowhere": "no such folder: /nowhere",
    "--urdf arm.urdf --package a": "must have the form NAME=FOLDER",
    "--urdf arm.urdf --xacro-arg a=1": "--xacro-arg is for xacro files",
    "--urdf arm.urdf --tip x": "no link or frame 'x'",
    "--urdf arm.urdf --target none.urdf": "none.urdf: no such file; give its URDF",
    "--urdf arm.urdf --target ''": "is a folder; give its URDF",
    "--urdf arm.urdf --target arm.urdf": "a target is rigid, but joint",
    "--urdf arm.urdf --target bare.urdf": "no frame where it could be held; add",
    "--urdf arm.urdf --bus-size 1": "--bus-size: needs a bus; add --bus-mass KG",
    "--urdf arm.urdf --thrusters 12x5N --driven joints": "--thrusters: cannot act with --driven",
    "--urdf arm.urdf --wheels 4 --driven joints": "--wheels: cannot act with --driven joints",
    "--urdf gripper.urdf --panels 2x20kg":
        "--panels: 2 of 20 kg must be less than half of the base's 60 kg",
    "--urdf alone.urdf": "mount an arm on a bus with --bus-mass KG",
    "--urdf alone.urdf --bus-mass 0": "--bus-mass: must be > 0 kg, not 0",
    "--urdf alone.urdf --bus-mass inf": "--bus-mass: must be > 0 kg, not inf",
    "--urdf alone.urdf --bus-mass 1e-300 --bus-size 1e-100": "no usable inertia",
    "--urdf alone.urdf --bus-mass 400 --bus-size 1,2":
        "--bus-size: must be one side or three, > 0 m, not 1,2",
    "--urdf alone.urdf --bus-mass 400 --bus-size wide": "'wide' must be a side in m, or three",
    "--urdf feet.urdf --bus-mass 400": "one link must be the arm's foot",
    "--urdf beside.urdf --bus-mass 400": "that are not fixed to the world",
    "--urdf box.urdf --bus-mass 400": "has no joint that moves",
    f"{TIPS} left_hand,left_hand": "both tips are 'left_hand'",
    f"{TIPS} left_hand,left_3": "are on one arm",
    f"{TIPS} left_5,left_2": "are on one arm",
    f"{TIPS} left_hand,nose": "no link or frame 'nose' for the tip",
    f"{TIPS} bus,left_hand": "tip 'bus' does not move",
    f"{TIPS} left_hand,": "must be the frames of two hands",
    f"{TIPS} left_hand,right_hand,nose": "must be the frames of two hands",
    f"{TIPS} left_hand,right_hand --tip left_hand": "--tips are two",
    f"{TIPS} left_hand,right_hand --target held.urdf": "two hands need another, 'grasp_2'",
}  # fmt: skip
PLACES = {  # folder -> what is told
    "full": "is not empty; name a new folder",
    "arm.urdf": "is a file; name a new folder",
    "paper": "name of a scenario that ships",
}


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("full").mkdir()
    Path("full/work.txt").write_text("mine")
    for name, text in FILES.items():
        Path(f"{name}.urdf").write_text(text)


def assert_refused(folder: str, words: str, told: str) -> None:
    before = sorted(Path.cwd().rglob("*"))
    result = CliRunner().invoke(main, ["new", folder, *shlex.split(words)])
    assert result.exit_code == 2, result.output
    line = result.output.splitlines()[-1]
    assert told in line
    assert line.startswith(("error: ", "Error: "))
    assert sorted(Path.cwd().rglob("*")) == before


@pytest.mark.parametrize("words", REFUSED)
def test_options_refused_in_one_line(words: str) -> None:
    assert_refused("deep/mine", words, REFUSED[words])


@pytest.mark.parametrize("folder", PLACES)
def test_folders_refused_in_one_line(folder: str) -> None:
    assert_refused(folder, "--urdf arm.urdf", PLACES[folder])
    assert Path("full/work.txt").read_text() == "mine"
