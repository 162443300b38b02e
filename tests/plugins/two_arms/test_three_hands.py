"""Three arms around one target."""

from pathlib import Path

import numpy as np
import pytest
from drawn_arms import ARMS, Arm, held_together
from scipy.spatial.transform import Rotation

from ffsm_drake import Scenario, ScenarioError, simulate

SIDES = ("left", "right", "third")


def three_arms(folder: Path, kind: int, *overrides: str) -> Scenario:
    """Arms of ``ARMS`` with 3, 6 or 7 joints, each turned by 120 deg about z."""
    axes, lengths, joints, place = ARMS[kind]
    turns = [Rotation.from_euler("z", 120 * index, degrees=True) for index in range(3)]
    arms = {
        side: Arm(axes, lengths, joints, turn.apply(place), turn)
        for side, turn in zip(SIDES, turns, strict=True)
    }
    lasts = ("reference.duration=3", "duration=4", *overrides)
    return held_together(folder, arms, moved=0.05, overrides=lasts)


@pytest.mark.parametrize(
    ("kind", "closes"),
    [
        (3, (0, 1)),
        (6, (1, 0.5)),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in ((3, (1, 0)), (7, (0, 0)), (6, (1, 1)), (7, (0.5, 1)))
        ),
    ],
)
def test_three_hands_hold_and_close_in_any_order(
    tmp_path: Path, kind: int, closes: tuple[float, float]
) -> None:
    late = [f"contacts.{side}.closes={time}" for side, time in zip(SIDES[1:], closes, strict=True)]
    run = simulate(three_arms(tmp_path, kind, *late), check_stability=False)
    assert run.outcome.status == "completed"
    assert max(run.metrics["final_error"].values()) < 1e-5
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert run.metrics["contacts"]["force_at_end"] < 5.0
    wrench = run.dataset["contact_wrench"]
    names = wrench["contact_wrench_component"].values.tolist()
    for side, time in zip(SIDES[1:], closes, strict=True):
        own = wrench.values[:, [name.startswith(side) for name in names]]
        assert own.shape[1] == 6
        assert not own[: round(100 * time)].any()
        assert (np.abs(own[round(100 * time) + 1 :]).max(axis=1) > 0.0).all()


def test_a_third_hand_on_the_arm_of_another_is_refused(tmp_path: Path) -> None:
    for link in ("right5", "right2", "left4", "base"):
        given = three_arms(tmp_path, 6, f"contacts.third.effector=servicer::{link}")
        with pytest.raises(ScenarioError, match=r"contacts.third.effector: '.*name ") as caught:
            simulate(given, check_stability=False)
        assert "\n" not in str(caught.value)
