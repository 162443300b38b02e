from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Whole simulations in machine code: sensing, law, limits, plant, integrator, traced once",
    page="many_runs",
    extras=("compiled",),
    needs=("equations", "tape"),
    uses=("actuators",),
    brings={
        "engines": {"compiled": "compiled.engine:Compiled"},
        "traced_samples": {"compiled": "compiled.sample:traced_sample"},
    },
)
