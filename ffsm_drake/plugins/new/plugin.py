from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="A first scenario from your URDF (``ffsm new``)",
    page="own_arm",
    extras=("xacro",),
    needs=("actuators", "design"),
    brings={
        "commands": {"new": "new.command:new"},
        "model_formats": {"new": "new.formats:FORMATS"},
    },
)
