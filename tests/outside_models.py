"""Spacecraft of other authors as free-floating scenarios, and joint torques from a table."""

from pydrake.systems.framework import LeafSystem

from ffsm_drake import load_scenario


def free_floating_scenario(folder, urdf, *, last, joints, more=()):
    """A scenario in which only the joints of a URDF are driven, without noise and disturbance.

    Args:
      folder: where the URDF and its directives are written.
      urdf: text.
      last: name, mass, centre of mass and moments (3) of the last link, the "payload".
      joints: name -> angle, rad, at the start.
      more: further overrides.
    """
    (folder / "outside.urdf").write_text(urdf)
    (folder / "outside.dmd.yaml").write_text(
        f"directives:\n- add_model:\n    name: outside\n    file: file://{folder}/outside.urdf\n"
    )
    name, mass, center, moments = last
    payload = {"mass": mass, "center_of_mass": list(center), "inertia": list(moments)}
    return load_scenario(
        "postcapture",
        [
            f"model.directives={folder}/outside.dmd.yaml", f"model.end_effector=outside::{name}",
            f"payload={{body: 'outside::{name}', truth: {payload}, nominal: {payload}}}",
            f"initial_posture.joints={joints}", f"target_posture.joints={joints}",
            "initial_posture.base_rpy=[0, 0, 0]", "target_posture.base_rpy=[0, 0, 0]",
            "initial_posture.base_position=[0, 0, 0]", "target_posture.base_position=[0, 0, 0]",
            "actuation.driven=[joints]", "actuation.limit={}", "tolerance=1.0",
            "disturbance.harmonics={}", "sensing.velocity_noise=0", *more,
        ],
    )  # fmt: skip


def torques(table):
    """A controller: row k of joint torques (n, joints), N m, from sample k to the next."""

    class Torques(LeafSystem):
        def __init__(self, setup):
            super().__init__()
            nv = len(setup.coordinates.names)
            self.sample_time = setup.sample_time
            self.DeclareVectorInputPort("estimated_state", 2 * nv + 1)
            self.DeclareVectorInputPort("desired_state", 2 * nv + 1)
            self.DeclareVectorInputPort("desired_acceleration", nv)
            self.DeclareStateOutputPort("generalized_force", self.DeclareDiscreteState(nv))
            self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, self.update)

        def update(self, context, values):
            row = min(round(context.get_time() / self.sample_time), len(table) - 1)
            force = values.get_mutable_value()
            force[:] = 0.0
            force[6:] = table[row]

    return Torques
