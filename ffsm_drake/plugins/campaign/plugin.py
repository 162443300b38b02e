from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Campaigns: thousands of runs with dispersed values, in one database, with one report",
    page="campaigns",
    extras=("parquet",),
    needs=("design", "workers"),
    uses=("capture", "meshcat"),
    brings={
        "commands": {"campaign": "campaign.command:campaign"},
        "verbs": {"run_campaign": "campaign.run:run_campaign"},
    },
)
