from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Missions as Gymnasium environments, for one spacecraft or several",
    page="gymnasium",
    extras=("gymnasium",),
    needs=("policy", "task_space"),
)
