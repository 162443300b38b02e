from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="What live views of a run share: pages of one address only, and an operator's inputs",
    page="live_view_access",
)
