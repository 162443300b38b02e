"""From a URDF of one's own to a run that settles; the same from the shell:

ffsm new out/own_arm/courier --urdf out/own_arm/courier.urdf
ffsm run out/own_arm/courier/courier.yaml
"""

import shutil
from pathlib import Path

import ffsm_drake
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.show.tables import results_table

LINK = """<link name="{}"><inertial><origin xyz="0 0 {}"/><mass value="{}"/>
  <inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/>
  <origin xyz="0 0 {}"/><axis xyz="{}"/>
  <limit lower="{}" upper="{}" effort="40" velocity="0.5"/></joint>"""
TOOL = """<link name="tool"/><joint name="tool_mount" type="fixed"><parent link="boom"/>
  <child link="tool"/><origin xyz="0 0 0.6"/></joint>"""  # the end, where targets are held
LINKS = (  # name, height of the centre of mass [m], mass [kg], moments of inertia [kg m^2]
    ("bus", 0.0, 180, 30, 30, 30),
    ("turret", 0.1, 5, 0.05, 0.05, 0.05),
    ("arm", 0.4, 6, 0.4, 0.4, 0.4),
    ("boom", 0.3, 4, 0.2, 0.2, 0.2),
)
JOINTS = (  # name, type, parent, child, height [m], axis, limits [rad or m]
    ("yaw", "revolute", "bus", "turret", 0.5, "0 0 1", -3, 3),
    ("shoulder", "revolute", "turret", "arm", 0.2, "0 1 0", -2, 2),
    ("extension", "prismatic", "arm", "boom", 0.6, "0 0 1", 0, 0.6),
)


def main():
    folder = Path("out/own_arm")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    parts = [LINK.format(*link) for link in LINKS] + [JOINT.format(*joint) for joint in JOINTS]
    parts.append(TOOL)
    (folder / "courier.urdf").write_text(f'<robot name="courier">{"".join(parts)}</robot>')
    started = new_scenario(folder / "courier.urdf", folder / "courier")
    print(started.summary())
    record = ffsm_drake.simulate(ffsm_drake.load_scenario(started.scenario_file))
    print(results_table([record]))
    ffsm_drake.write_outputs([record], folder, figures=False)


if __name__ == "__main__":
    main()
