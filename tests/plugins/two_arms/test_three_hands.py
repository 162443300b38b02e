"""Three arms around one target."""

from pathlib import Path

import numpy as np
import pytest
from drawn_arms import ARMS, inertial, text
from scipy.spatial.transform import Rotation

from ffsm_drake import Scenario, ScenarioError, load_scenario, simulate

SIDES = ("left", "right", "third")


def three_arms(folder: Path, kind: int, *overrides: str) -> Scenario:
    """Arms of ``ARMS`` with 3, 6 or 7 joints, each turned by 120 deg about z."""
    axes, lengths, joints, place = ARMS[kind]
    along = np.array([0.0, 1.0, 0.0] if kind == 3 else [0.0, 0.0, 1.0])
    urdf, hands = [f'<robot name="servicer"><link name="base">{inertial(100, 20)}</link>'], {}
    for index, side in enumerate(SIDES):
        turn = Rotation.from_euler("z", 120 * index, degrees=True)
        where, parent = turn.apply(place), "base"
        at, rpy = where, turn.as_euler("xyz")
        for k, (axis, length) in enumerate(zip(axes, lengths, strict=True)):
            unit = np.array([axis == each for each in "xyz"], dtype=float)
            urdf.append(
                f'<link name="{side}{k}">{inertial(2, 0.02, along * length / 2)}</link>'
                f'<joint name="{side}_{k + 1}" type="continuous"><parent link="{parent}"/>'
                f'<child link="{side}{k}"/><origin xyz="{text(at)}" rpy="{text(rpy)}"/>'
                f'<axis xyz="{text(unit)}"/></joint>'
            )
            turn = turn * Rotation.from_rotvec(unit * joints[k])
            parent, at, rpy = f"{side}{k}", along * length, np.zeros(3)
            where = where + turn.apply(at)
        urdf.append(f'<frame name="{side}_hand" link="{parent}" xyz="{text(at)}" rpy="0 0 0"/>')
        hands[side] = where, turn.as_euler("xyz")
    middle = np.mean([where for where, _ in hands.values()], axis=0)
    target = [f'<robot name="debris"><link name="debris">{inertial(20, 2)}</link>']
    for side, (where, rpy) in hands.items():
        pose = f'xyz="{text(where - middle)}" rpy="{text(rpy)}"'
        target.append(f'<frame name="{side}_grasp" link="debris" {pose}/>')
    for name, lines in (("servicer", urdf), ("debris", target)):
        (folder / f"{name}.urdf").write_text("\n".join([*lines, "</robot>"]))
    others = dict.fromkeys([f"joint_{k}" for k in range(1, 6)])
    postures = [
        others
        | {
            f"{side}_{k + 1}": float(angle) + moved * (side == "left")
            for side in SIDES
            for k, angle in enumerate(joints)
        }
        for moved in (0.0, 0.05)
    ]
    given = {
        "model": {
            "directives": None,
            "servicer": str(folder / "servicer.urdf"),
            "debris": str(folder / "debris.urdf"),
            "end_effector": "servicer::left_hand",
            "grasp": "debris::left_grasp",
        },
        "contacts": {
            side: {"effector": f"servicer::{side}_hand", "frame": f"debris::{side}_grasp"}
            for side in SIDES
        },
        "initial_posture": {"joints": postures[0]},
        "target_posture": {"joints": postures[1]},
        "disturbance": {"harmonics": others},
        "payload": {
            "truth": {"mass": 25.0, "inertia": [2.5, 2.5, 2.5]},
            "nominal": {"mass": 20.0, "inertia": [2.0, 2.0, 2.0]},
        },
        "reference": {"base_rotation": "eigenaxis", "duration": 3.0},
        "duration": 4.0,
    }
    return load_scenario("postcapture", [given, *overrides])


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
