"""The same goal in the inertial frame with the Jacobian of a fixed base and with the generalized
Jacobian.

python docs/draw_free_floating.py

With thrusters off the base reacts to the arm. Joints that would reach the goal on a fixed base miss
it; those that the generalized Jacobian gives do not. Prints the table and draws the figure of
docs/how_a_free_base_moves.md.
"""

import argparse
import dataclasses
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import ffsm_drake
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.task_space.free_motion import FreeMotion
from ffsm_drake.show.figures.axes import STYLE
from ffsm_drake.show.style import BLUE, VERMILION
from ffsm_drake.spacecraft.coordinates import position_errors
from ffsm_drake.systems.frame_path import goal_frame, make_frame_path
from ffsm_drake.systems.reference import make_motion

# What is asked of the end effector, by scenario: the planar arm has three joints, the other five.
GOALS = {
    "planar_detumble": "{position: [0.4, 0, 2.3], rpy: [0, 1.0, 0]}",
    "postcapture": "{task: position, position: [0.94, 0.52, 1.8]}",
}
AT_ORIGIN = ["initial_posture.base_position=[0, 0, 0]", "initial_posture.base_rpy=[0, 0, 0]"]
MOTION = (
    "reference={kind: quintic, goal: target_posture, plan: null, duration: 20, "
    "base_rotation: eigenaxis}"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """Distances between the end effector and its path, over time; the first column with the
    fixed-base Jacobian.
    """

    scenario: str
    times: np.ndarray  # (n) s
    position: np.ndarray  # (n, 2) m
    attitude: np.ndarray  # (n, 2) rad; None of it is asked of a position
    base_turn: np.ndarray  # (n, 2) rad


def compare(name: str) -> Comparison:
    given = [*AT_ORIGIN, MOTION, f"reference.frame={GOALS[name]}"]
    scenario = ffsm_drake.load_scenario(name, [*given, "actuation.driven=[joints]"])
    model = ffsm_drake.make_nominal_plant(scenario)
    resolved = make_motion(make_mission(scenario))
    # the base stays where it is
    held = ffsm_drake.load_scenario(name, [*given, "actuation.driven=[all]"])
    fixed = make_motion(make_mission(held))
    # its joints, with the base free
    played = FreeMotion(fixed, model=model, sample_time=scenario.sample_time)

    played.accuracy = 1e-8  # enough here, of what is itself integrated

    times, frame = np.linspace(0.0, resolved.end, 201), goal_frame(scenario, model.plant)
    path, misses, turns = make_frame_path(make_mission(scenario), model).rows(times), [], []
    for motion in (played, resolved):
        q = motion.rows(times)[:, : len(model.coordinates.position_names)]
        poses = np.empty((times.size, 7))
        for i, one in enumerate(q):
            model.plant.SetPositions(model.context, one)
            X_WF = frame.CalcPoseInWorld(model.context)
            poses[i] = *X_WF.rotation().ToQuaternion().wxyz(), *X_WF.translation()
        misses.append(position_errors(path[:, :7], poses))
        turns.append(
            np.linalg.norm(position_errors(q, np.tile(q[0], (times.size, 1)))[:, :3], axis=1)
        )
    return Comparison(
        scenario=name,
        times=times,
        position=np.stack([np.linalg.norm(miss[:, 3:], axis=1) for miss in misses], axis=1),
        attitude=np.stack([np.linalg.norm(miss[:, :3], axis=1) for miss in misses], axis=1),
        base_turn=np.stack(turns, axis=1),
    )


def draw(found: list[Comparison]) -> Figure:
    """The distance to the path over time, a panel for each servicer."""
    mpl.rcParams.update(STYLE)
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, one in zip(figure.subplots(1, len(found)), found, strict=True):
        for curve, color, label in zip(
            one.position.T, (VERMILION, BLUE), ("fixed-base J", "J*"), strict=True
        ):
            axes.semilogy(one.times, np.maximum(curve, 1e-16), color=color, label=label)
        axes.set_title(one.scenario)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("end effector from its path [m]")
        axes.legend()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/free_floating.png"), help="default: %(default)s"
    )
    options = parser.parse_args()
    found = [compare(name) for name in GOALS]
    print("At the end                     position [m]   attitude [rad]   base turned [rad]")
    for one in found:
        for column, label in enumerate(("fixed-base J", "J*")):
            asked = "position" not in GOALS[one.scenario].partition("task:")[2].partition(",")[0]
            attitude = f"{one.attitude[-1, column]:.3g}" if asked else "-"
            turn = f"{one.base_turn[-1, column]:.3g}"
            print(
                f"{one.scenario:16} {label:14} {one.position[-1, column]:11.3g} {attitude:>16} "
                f"{turn:>19}"
            )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    draw(found).savefig(options.out, dpi=150)
    print(f"Written to {options.out}.")


if __name__ == "__main__":
    main()
