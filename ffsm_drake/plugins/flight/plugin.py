from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="The control law of a scenario as C code for a flight computer; law and plant as FMUs",
    page="flight_code",
    needs=("compiled", "equations", "tape"),
    brings={
        "scenario_exporters": {
            "c": "flight.export:write_c",
            "fmu": "flight.fmu:write_fmu",
        },
    },
)
