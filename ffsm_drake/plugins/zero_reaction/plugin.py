from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Adaptive zero reaction control: the arm moves a frame and keeps the base's attitude",
    page="baselines",
    needs=("baselines", "task_space"),
    brings={
        "controllers": {
            "adaptive_zero_reaction": "zero_reaction.adaptive_zero_reaction:AdaptiveZeroReaction"
        },
    },
)
