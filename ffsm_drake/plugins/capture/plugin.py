from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Capture of a moving target: approach, grasp, closing gripper; supervisor of a mission",
    page="capture",
    uses=("task_space", "two_arms"),
    brings={
        "sections": {
            "forces.gripper": "capture.gripper:Gripper",
            "supervisor": "capture.supervisor:SupervisorPart",
        },
        "phases": {"hold": "capture.phases.hold:hold"},
        "graspings": {"capture": "capture.planned:PLANNED"},
        "mission_phases": {"capture": "capture.phases.sequence:phases_of_capture"},
        "target_views": {"capture": "capture.phases.sequence:view_of_target"},
        "report_sections": {"grasp": "capture.page:grasp_section"},
    },
)
