from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Control laws from the literature as baselines",
    page="baselines",
    brings={
        "controllers": {
            "coordinated": "baselines.coordinated:Coordinated",
            "fixed_time": "baselines.fixed_time:FixedTime",
            "fixed_time_observer": "baselines.fixed_time_observer:FixedTimeObserver",
            "mpc": "baselines.mpc:Mpc",
            "nmpc": "baselines.nmpc:Nmpc",
            "prescribed_performance": "baselines.prescribed_performance:PrescribedPerformance",
            "slotine_li": "baselines.slotine_li:SlotineLi",
            "super_twisting": "baselines.super_twisting:SuperTwisting",
            "terminal_sliding_mode": "baselines.terminal_sliding_mode:TerminalSlidingMode",
        },
    },
)
