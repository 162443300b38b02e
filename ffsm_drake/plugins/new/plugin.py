from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="A first scenario from your URDF (``ffsm new``)",
    page="own_arm",
    extras=("xacro",),
    needs=("actuators", "design"),
    brings={
        "commands": {"new": "new.command:new"},
        "services": {
            "model_as_urdf": "new.urdf.formats:as_urdf",
            "model_trial": "new.apart:check_by_trial",
        },
    },
)
