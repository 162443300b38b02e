from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Flexible parts of the spacecraft: panels, beams, slosh, passive joints and gears",
    page="flexible",
    brings={
        "sections": {
            "flexible": "flexible.deflections:Deflections",
            "forces.backlash": "flexible.backlash:GearBacklash",
        },
        "effects": {"backlash": "flexible.backlash_settings:Backlash"},
        "flexible_parts": {"flexible": "flexible.parts:PARTS"},
        "deflection_views": {"flexible": "flexible.meshcat:Deflections"},
    },
)
