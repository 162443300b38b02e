from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Capture of a moving target: approach, grasp, closing gripper; supervisor of a mission",
    page="capture",
    brings={
        "sections": {
            "forces.gripper": "capture.gripper:Gripper",
            "supervisor": "capture.supervisor:SupervisorPart",
        },
        "phases": {"hold": "capture.phases.hold:hold"},
        "services": {
            "capture_mission": "capture.mission:phases_of_capture",
            "capture_rollout": "capture.mission:MissionRollout",
            "grasped_at_start": "capture.grasping:grasped_at_start",
            "grasp_lines": "capture.tables:grasp_lines",
            "momentum_budget": "capture.momentum:momentum_budget",
            "planned_approach": "capture.approach:planned_approach",
            "planned_contact": "capture.contact:planned_contact",
        },
        "report_sections": {"grasp": "capture.page:grasp_section"},
    },
)
