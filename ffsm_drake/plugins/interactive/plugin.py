from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Live runs and an operator's panel in the browser",
    page="meshcat",
    needs=("live", "meshcat"),
    brings={
        "live": {
            "controls": "interactive.panel:run_interactive",
            "meshcat": "interactive.panel:watch",
        },
    },
)
