from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Equations of motion of one spacecraft, on numbers or on symbols",
    page="many_runs",
    needs=("tape",),
)
