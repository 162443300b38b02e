from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Limits and delays of actuators, joint drives, reaction wheels, thrusters and plumes",
    page="actuators",
    brings={
        "sections": {
            "actuation": "actuators.row:ActuatorRow",
            "actuation.drives": "actuators.drives:JointDrives",
            "actuation.thrusters": "actuators.thrusters:FiredThrusters",
            "actuation.wheels": "actuators.wheels:ReactionWheels",
            "forces.plume": "actuators.plumes:Plumes",
        },
        "acting_blocks": {"actuators": "actuators.row:acting_blocks"},
    },
)
