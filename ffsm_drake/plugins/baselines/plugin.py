from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Control laws from the literature as baselines",
    page="baselines",
    brings={
        "controllers": {
            "coordinated": "baselines.coordinated:Coordinated",
            "fixed_time": "baselines.fixed_time:FixedTime",
            "mpc": "baselines.mpc:Mpc",
            "nmpc": "baselines.nmpc:Nmpc",
            "slotine_li": "baselines.slotine_li:SlotineLi",
            "super_twisting": "baselines.super_twisting:SuperTwisting",
            "terminal_sliding_mode": "baselines.terminal_sliding_mode:TerminalSlidingMode",
        },
    },
)
