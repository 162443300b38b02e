from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Block diagrams of the closed loop, as Graphviz text and pictures",
    page="command_line",
    uses=("meshcat",),
    brings={
        "commands": {"diagram": "diagrams.command:diagram"},
    },
)
