from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Optimal motions to rest within every limit, and the TVLQR law that tracks them",
    page="planning",
    needs=("design", "equations", "tape", "task_space"),
    uses=("two_arms",),
    brings={
        "commands": {"plan": "planning.command:plan"},
        "controllers": {"tvlqr": "planning.tvlqr:Tvlqr"},
    },
)
