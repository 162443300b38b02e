from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Faults of sensors and actuators, and their detection",
    page="faults",
    needs=("actuators", "estimators"),
    brings={
        "jammed_joints": {"jam": "faults.jam:jammed_joints"},
        "sections": {
            "forces.jam": "faults.jam:JammedJoints",
            "sensing.detection": "faults.detection:FaultDetection",
            "sensing.faults": "faults.sensors:FaultySensors",
        },
    },
)
