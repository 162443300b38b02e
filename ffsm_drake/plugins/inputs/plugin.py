from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Copies of the models, plans, policies and modules of a run in its folder, to repeat it",
    page="repeat_a_run",
    brings={
        "input_copies": {"inputs": "inputs.keeping:COPIES"},
    },
)
