from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Code for numbers and arrays, traced: on symbols it leaves a list of operations",
    page="many_runs",
)
