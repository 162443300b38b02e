"""From a user-supplied URDF to a converged run; the same from the shell:

ffsm new out/own_servicer/courier --urdf courier.urdf
ffsm run out/own_servicer/courier/courier.yaml
"""

import shutil
from pathlib import Path

import ffsm_drake
from ffsm_drake.control_design.first_scenario import new_scenario
from ffsm_drake.show.tables import results_table

LINK = """<link name="{name}"><inertial><origin xyz="{place}"/><mass value="{mass}"/>
  <inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{place}"/>
  <axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="40" velocity="0.5"/></joint>"""
URDF = "".join(
    (
        '<robot name="courier">',
        LINK.format(name="bus", place="0 0 0", mass=180, i=30),
        LINK.format(name="turret", place="0 0 0.1", mass=5, i=0.05),
        LINK.format(name="arm", place="0 0 0.4", mass=6, i=0.4),
        LINK.format(name="boom", place="0 0 0.3", mass=4, i=0.2),
        JOINT.format(
            name="yaw",
            kind="revolute",
            parent="bus",
            child="turret",
            place="0 0 0.5",
            axis="0 0 1",
            low=-3,
            high=3,
        ),
        JOINT.format(
            name="shoulder",
            kind="revolute",
            parent="turret",
            child="arm",
            place="0 0 0.2",
            axis="0 1 0",
            low=-2,
            high=2,
        ),
        JOINT.format(
            name="extension",
            kind="prismatic",
            parent="arm",
            child="boom",
            place="0 0 0.6",
            axis="0 0 1",
            low=0,
            high=0.6,
        ),
        "</robot>",
    )
)


def main():
    folder = Path("out/own_servicer")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "courier.urdf").write_text(URDF)
    started = new_scenario(folder / "courier.urdf", folder / "courier")
    print(started.summary())
    record = ffsm_drake.simulate(ffsm_drake.load_scenario(started.scenario_file))
    print(results_table([record]))
    ffsm_drake.write_outputs([record], folder, figures=False)


if __name__ == "__main__":
    main()
