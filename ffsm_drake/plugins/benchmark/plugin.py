from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="A benchmark that ranks control laws on published missions, next to lower bounds",
    page="benchmark",
    needs=("actuators", "campaign", "capture", "design", "workers"),
    brings={
        "commands": {"benchmark": "benchmark.command:benchmark"},
    },
)
