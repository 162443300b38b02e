from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Laws and motions for the pose of a frame, and motions with undriven coordinates",
    page="free_floating",
    brings={
        "controllers": {
            "resolved_rate": "task_space.resolved_rate:ResolvedRate",
            "task_computed_torque": "task_space.task_computed_torque:TaskComputedTorque",
            "task_time_delay": "task_space.task_time_delay:TaskTimeDelay",
            "torque_against_momentum": "task_space.torque_against_momentum:TorqueAgainstMomentum",
        },
        "followers": {
            "actuation.driven": "task_space.following:free_motion",
            "reference.frame": "task_space.following:resolved_motion",
        },
    },
)
