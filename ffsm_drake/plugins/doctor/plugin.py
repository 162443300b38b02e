from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="A check of the installation",
    uses=("meshcat",),
    brings={
        "commands": {"doctor": "doctor.command:doctor"},
    },
)
