from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Reproduction of the paper's table and figures, with a verdict on each claim",
    page="reproduction",
    needs=("analysis", "design", "diagrams", "workers"),
    brings={
        "commands": {"reproduce": "paper.command:reproduce"},
    },
)
