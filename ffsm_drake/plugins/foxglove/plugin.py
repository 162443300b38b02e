from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="A run live in Foxglove",
    page="interfaces",
    extras=("mcap",),
    needs=("exports", "live"),
    brings={
        "live": {"foxglove": "foxglove.view:watch"},
    },
)
