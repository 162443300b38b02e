from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Audits of logs from other simulators: do they obey the equations of motion?",
    page="audit",
    extras=("mcap", "ros2"),
    uses=("new",),
    brings={
        "commands": {"audit": "audit.command:audit"},
    },
)
