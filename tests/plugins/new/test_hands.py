"""Crafts whose two arms hold the target together."""

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from outside_urdfs import link, robot, two_hands

from ffsm_drake import simulate
from ffsm_drake.cli import main
from ffsm_drake.common.errors import FfsmError, ModelError
from ffsm_drake.plugins.design.remarks import plan_clearance
from ffsm_drake.plugins.new import hands
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.first_mission import FirstMission
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.plugins.new.result import NewScenario
from ffsm_drake.scenario import load_scenario

SPATIAL = "zyyxyx"  # axes of an arm's joints
BOX = robot(
    link("box", mass=30, inertia=(1, 1, 1)),
    '<frame name="grasp" link="box" xyz="-0.2 0 0" rpy="0 1.5707963 0"/>',
    '<frame name="grasp_2" link="box" xyz="0.2 0 0" rpy="0 -1.5707963 0"/>',
)


CAPTURE = {"capture": "5deg/s", "thrusters": "16", "wheels": "4", "sensors": "flight"}


def made(
    folder: Path, text: str, *hands: str, words: dict[str, str] | None = None, **options: object
) -> NewScenario:
    (folder / "craft.urdf").write_text(text)
    tips = hands or ("left_hand", "right_hand")
    return new_scenario(
        folder / "craft.urdf",
        folder / "made",
        asked=Asked.parsed(tips=",".join(tips), **(words or {})),
        **options,  # type: ignore[arg-type]
    )


def settles(new: NewScenario) -> bool:
    """Whether the mission does, with a closed chain and within the joints' limits."""
    run = simulate(load_scenario(new.scenario_file))
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert np.abs(run.dataset["position"].values[:, 7:]).max() < 2.6
    return run.ending.is_settled


@pytest.mark.long
@pytest.mark.parametrize(
    ("axes", "torso"), [("zzz", False), ("zyyxyxz", False), (SPATIAL, True), (SPATIAL, False)]
)
def test_two_arms_settle(tmp_path: Path, axes: str, torso: bool) -> None:
    new = made(tmp_path, two_hands(axes, torso=torso))
    assert settles(new)
    assert [each.effector for each in new.scenario.contacts.values()] == [
        "servicer::left_hand",
        "servicer::right_hand",
    ]
    assert new.data()["second_tip"] == "right_hand"
    assert f"tip         right_hand, {len(axes) + torso} joints" in new.summary()


@pytest.mark.long
def test_both_hands_capture_one_after_the_other(tmp_path: Path) -> None:
    """The file is short, the approach begins with open hands, and the run settles."""
    new = made(tmp_path, two_hands(SPATIAL), words=CAPTURE, payload_mass=100.0)
    given = load_scenario(new.scenario_file)
    assert len(new.scenario_file.read_text().splitlines()) < 60
    assert given.approach is not None
    assert given.approach.start == "clear"
    assert [each.closes for each in given.contacts.values()] == [0.0, 5.0]
    assert settles(new)


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        {"driven": "joints"},
        {"driven": "joints", "capture": "1deg/s"},
        {"driven": "base_rotation,joints", "capture": "1deg/s", "wheels": "4", "sensors": "flight"},
    ],
    ids=lambda words: "-".join(words),
)
def test_two_arms_on_a_base_that_is_not_driven_settle(
    tmp_path: Path, words: dict[str, str]
) -> None:
    new = made(tmp_path, two_hands(SPATIAL), words=words, payload_mass=50.0)
    assert new.scenario.actuation.driven == words["driven"].split(",")
    assert settles(new)


class _PlacedError(FfsmError):
    """The end of a search, before durations and gains are chosen."""


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_hands_that_extend_beyond_their_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Drawn lengths of arms and hands: the hands may be in the target at its grasp, and are named
    with their depths. The approach begins with a target that nothing touches.
    """
    drafts, distances = list[FirstMission](), list[float]()

    def stop(self: FirstMission) -> None:
        drafts.append(self)
        distances.extend(each.distance for each in plan_clearance(self.mission))
        raise _PlacedError("placed")

    monkeypatch.setattr(FirstMission, "pace", stop)
    rng = np.random.default_rng(seed)
    text, deep = two_hands(SPATIAL, torso=bool(seed), reach=rng.uniform(1.4, 1.8)), {}
    for side in ("left", "right"):
        deep[side] = rng.uniform(0.03, 0.15)
        shape = f'<box size="0.06 0.06 {deep[side] + 0.1}"/>'
        place = f'<origin xyz="0 0 {0.5 * (deep[side] - 0.1)}"/>'
        hand = f"<visual>{place}<geometry>{shape}</geometry></visual>"
        text = text.replace(f'<link name="{side}_hand">', f'<link name="{side}_hand">{hand}')
    with pytest.raises(ModelError, match="placed"):
        made(tmp_path, text, words=CAPTURE, payload_mass=50.0, payload_size=0.4)
    found = drafts[-1]
    assert found.is_held
    assert not found.touching
    told = dict(re.findall(r"the shape of '(\w+)_hand' is (\d+) mm deep", "; ".join(found.remarks)))
    assert {side: float(depth) for side, depth in told.items()} == pytest.approx(
        {side: 1e3 * depth for side, depth in deep.items()}, abs=1.0
    )
    assert min(distances) >= found.scenario.clearance


@pytest.mark.long
def test_a_target_from_a_file_is_held_at_its_two_frames(tmp_path: Path) -> None:
    (tmp_path / "box.urdf").write_text(BOX)
    new = made(tmp_path, two_hands(SPATIAL), target=tmp_path / "box.urdf")
    assert new.scenario.contacts["second"].frame == "debris::grasp_2"
    assert settles(new)


@pytest.mark.parametrize("seed", range(6))
def test_an_arm_with_too_few_joints_of_its_own(tmp_path: Path, seed: int) -> None:
    """Fewer than the target's motions: 6 in space, 3 in a plane, shared joints not counted."""
    rng = np.random.default_rng(seed)
    axes = "zz" if seed == 0 else "".join(rng.choice(list("xyz"), rng.integers(3, 6)))
    longer = "zzz" if seed == 0 else SPATIAL
    arms = (longer, axes) if seed % 2 else (axes, longer)
    text = two_hands(arms[0], other=arms[1], torso=seed > 2)
    short = "right_hand" if seed % 2 else "left_hand"
    with pytest.raises(FfsmError, match=f"--tips: the arm of '{short}' has {len(axes)} joints"):
        made(tmp_path, text)


@pytest.mark.slow
def test_hands_that_cannot_both_reach(tmp_path: Path) -> None:
    (tmp_path / "craft.urdf").write_text(two_hands(SPATIAL, reach=0.4))
    result = CliRunner().invoke(
        main,
        f"new {tmp_path}/made --urdf {tmp_path}/craft.urdf --tips left_hand,right_hand "
        "--target 5kg,0.1m",
    )
    assert result.exit_code == 2
    assert "'left_hand' and 'right_hand' cannot both hold the target (a cube of 0.1 m)" in (
        result.output
    )
    assert "; nor one of 0.05, 0.025, 0.0125 m; what may help: " in result.output
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("seed", "most"), [pytest.param(0, 40_000, marks=pytest.mark.slow), (1, 50), (2, 50)]
)
def test_the_search_for_hands_that_hardly_reach_is_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, most: int
) -> None:
    """The second hand gets near the target and cannot turn to it, with any number of joints: the
    inverse kinematics, each of whose steps solves for joint rates, are tried from few postures, and
    end at a bound.
    """
    monkeypatch.setattr(hands, "_MOST_STEPS", most)
    solved, solve = [0], np.linalg.lstsq

    def count(*arguments: object, **options: object) -> object:
        solved[0] += 1
        return solve(*arguments, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(np.linalg, "lstsq", count)
    rng = np.random.default_rng(seed)
    text = two_hands(SPATIAL + "".join(rng.choice(list("xyz"), rng.integers(0, 4))))
    narrow = re.sub(
        r'(name="right_[4-9]_joint".*?lower="-)2.6(" upper=")2.6', r"\g<1>1.0\g<2>1.0", text
    )
    (tmp_path / "box.urdf").write_text(BOX)
    with pytest.raises(ModelError, match=r"cannot both hold the target: none of \d+ p") as error:
        made(tmp_path, narrow, target=tmp_path / "box.urdf")
    assert "or another place of 'grasp_2'" in str(error.value)
    assert ("none of 300 " in str(error.value)) == (most > 15_000)
    # the last step of a try solves nothing; a posture of the first arm takes 50 steps at most
    assert 25 <= solved[0] < min(most + 50, 15_000)
