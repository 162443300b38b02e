from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Control barrier functions: the joints' limits, around any control law",
    page="barriers",
    brings={
        "command_filters": {"barriers": "barriers.guarded:with_barriers"},
        "linear_remarks": {"barriers": "barriers.margin:barrier_remark"},
    },
)
