"""The variables that every record holds: of the blocks' ports, and of the true plant."""

import functools

from ffsm_drake.loop import closed_loop
from ffsm_drake.systems import reference
from ffsm_drake.systems.controllers import controller
from ffsm_drake.systems.parts.signals import UNIT, Signal, state_signals
from ffsm_drake.systems.sensing import part as sensing

_of_plant = functools.partial(Signal, held=False)
_vector = functools.partial(_of_plant, dimension="axis")
_errors = functools.partial(_of_plant, dimension="coordinate")
# Name -> variable; those of ``controller`` for some control laws only.
RECORDED_SIGNALS = {
    each.name: each
    for each in (
        *state_signals("state", "", "generalized positions q", "generalized velocities v"),
        *sensing.MEASUREMENT_SIGNALS,
        *reference.REFERENCE_SIGNALS,
        _errors(
            name="error", unit=UNIT,
            meaning="true tracking error e = q_d - q (rotation vector in world)",
        ),
        _errors(name="error_rate", unit=f"{UNIT} per s", meaning="true error rate"),
        *closed_loop.FORCES,
        _vector(
            name="end_effector_position", unit="m", meaning="end effector in the world frame"
        ),
        _vector(name="desired_end_effector_position", unit="m", meaning="its reference"),
        _vector(name="base_rpy", unit="rad", meaning="roll, pitch, yaw of the base"),
        _vector(name="desired_base_rpy", unit="rad", meaning="their reference"),
        _vector(name="linear_momentum", unit="N s", meaning="total linear momentum"),
        _vector(
            name="angular_momentum", unit="N m s",
            meaning="total angular momentum about the world's origin",
        ),
        _of_plant(name="kinetic_energy", unit="J", meaning="total kinetic energy"),
        *controller.LAW_SIGNALS,
    )
}  # fmt: skip
