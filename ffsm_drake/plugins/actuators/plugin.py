from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Limits, delays and lost commands of actuators, drives, wheels, thrusters and plumes",
    page="actuators",
    brings={
        "sections": {
            "actuation": "actuators.row:ActuatorRow",
            "actuation.link": "actuators.link:CommandLink",
            "sensing.link": "actuators.sensor_link:MeasurementLink",
            "actuation.drives": "actuators.drives:JointDrives",
            "actuation.thrusters": "actuators.thrusters:FiredThrusters",
            "actuation.wheels": "actuators.wheels:ReactionWheels",
            "forces.plume": "actuators.plumes:Plumes",
        },
        "effects": {
            "link": "actuators.link_settings:Link",
            "sensor_link": "actuators.link_settings:SensorLink",
        },
        "acting_blocks": {"actuators": "actuators.row:acting_blocks"},
    },
)
