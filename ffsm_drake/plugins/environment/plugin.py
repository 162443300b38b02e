from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Forces in orbit: gravity gradient, tide and solar pressure",
    page="orbit",
    brings={
        "sections": {"forces.environment": "environment.environment:OrbitalEnvironment"},
    },
)
