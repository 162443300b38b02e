from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Errors of the arm's geometry that the controller does not know, and thermal expansion",
    page="geometry",
    brings={
        "effects": {"geometry": "geometry.settings:Geometry"},
        "true_geometry": {"geometry": "geometry.displaced:displace"},
        "sections": {"geometry": "geometry.part:DisplacedArm"},
    },
)
