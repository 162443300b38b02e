from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="The spacecraft in Meshcat: a page that plays back a run, and the stage of live views",
    page="meshcat",
    uses=("flexible",),
    brings={
        "commands": {"replay": "meshcat.command:replay"},
        "recordings": {"meshcat": "meshcat.recording:recording_html"},
        "meshcat_servers": {"meshcat": "meshcat.stage:start_meshcat"},
    },
)
