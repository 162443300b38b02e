"""A mission of one's own: a target that tumbles is grasped and brought to rest by thrusters, wheels
and joints, with flight sensors and solar panels that vibrate. From the shell, with the text below
in a file:

ffsm validate mission.yaml
ffsm run mission.yaml
"""

from pathlib import Path

import ffsm_drake
from ffsm_drake.show.tables import results_table

MISSION = """
extends: tumbling_capture
description: A capture with everything on board
duration: 60
controller: tdc
capture: {approach: null}          # from the grasp on; leave out to see the approach
reference: {duration: 40}          # a longer motion asks the wheels for less
payload: {truth: {mass: 90}}       # of which the controller knows nothing

model:
  flexible:
    port: {position: [0, 1, 0], direction: [0, 1, 0], mass: 5, frequency: 0.3}
    starboard: {position: [0, -1, 0], direction: [0, -1, 0], mass: 5, frequency: 0.3}

actuation:
  limit: {base_position: null, base_rotation: null}  # thrusters and wheels limit the base
  thrusters: {layout: 12x5N}
  wheels:
    assist_above: 1                # thrusters help with torque that the wheels cannot give
    units:
      wheel_1: {axis: [1, 1, 1], inertia: 0.08, torque_limit: 1, speed_limit: 628}
      wheel_2: {axis: [-1, 1, 1], inertia: 0.08, torque_limit: 1, speed_limit: 628}
      wheel_3: {axis: [-1, -1, 1], inertia: 0.08, torque_limit: 1, speed_limit: 628}
      wheel_4: {axis: [1, -1, 1], inertia: 0.08, torque_limit: 1, speed_limit: 628}

controllers:
  tdc: {k_d: {base_rotation: 10}, k_p: {base_rotation: 25}}  # 5 rad/s: wheels are weak
"""


def main():
    folder = Path("out/own_mission")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mission.yaml").write_text(MISSION)
    record = ffsm_drake.simulate(ffsm_drake.load_scenario(folder / "mission.yaml"))
    print(results_table([record]))
    print(record.ending.sentence)
    ffsm_drake.write_outputs([record], folder, figures=False)


if __name__ == "__main__":
    main()
