from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="An external controller over UDP: each sample sends the inputs and receives the force",
    page="interfaces",
)
