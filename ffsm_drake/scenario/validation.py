"""Checks of every value that need no plant."""

import dataclasses
import math
import re

import numpy as np
from pydrake.systems.analysis import GetIntegrationSchemes

from ffsm_drake.common.errors import ScenarioError, did_you_mean
from ffsm_drake.scenario.resolving import shown
from ffsm_drake.scenario.schema import (
    BASE_ROTATIONS,
    CAPTURE_AXES,
    DRIVEN,
    ESTIMATOR_KINDS,
    FLEXIBLE_KINDS,
    FRAME_JOINTS,
    FRAME_PRIORITIES,
    FRAME_TASKS,
    GOALS,
    GRASPING_JOINTS,
    MODULATORS,
    REFERENCE_KINDS,
    SERVICER_MOTIONS,
    SHAPER_KINDS,
    THRUSTER_FAILURES,
    Capture,
    Drives,
    Environment,
    Flexible,
    FrameGoal,
    MassProperties,
    Posture,
    Scenario,
    Shaper,
    Thrusters,
    Wheels,
    inertia_matrix,
)
from ffsm_drake.scenario.thruster_layouts import thruster_layouts, thrusters_of

_NAME = re.compile(r"[^\W\d]\w*|[^\W\d]\w*(\.\w+)*:[^\W\d]\w*(\.\w+)*")  # or module:attribute
# without an error estimate
FIXED_STEP_SCHEMES = ("explicit_euler", "runge_kutta2", "semi_explicit_euler")
MAX_SAMPLES = 10_000_000
MAX_DELAY = 1000  # control samples
MAX_MEAN_MOTION = 0.01  # rad/s; an orbit of ten minutes, which no body that holds together has
MIN_SEGMENTS, MAX_SEGMENTS = 4, 100  # of a plan's spline
MAX_FRAME = 1000  # control samples
MAX_THRUSTERS, MAX_WHEELS = 24, 24
MAX_PLATES, MAX_MODES = 10, 5
MAX_SHAPED = 4  # frequencies
MAX_STEPS = 1_000_000_000  # of the integrator; hours
_BYTES_PER_SAMPLE = 4000  # of a run's logs and record, for the estimate in an error


def validate(scenario: Scenario) -> None:
    """Check every value that can be checked without building the plant; raise ScenarioError naming
    the key.
    """
    require(0 <= scenario.random_seed < 2**31, "random_seed", "must be from 0 to 2147483647")
    require(scenario.duration > 0, "duration", "must be > 0 s")
    require(scenario.sample_time > 0, "sample_time", "must be > 0 s")
    samples = scenario.duration / scenario.sample_time
    require(
        samples <= MAX_SAMPLES,
        "sample_time" if scenario.duration < 1000.0 else "duration",
        f"{scenario.duration:g} s in samples of {scenario.sample_time:g} s are {samples:.3g}, "
        "about "
        f"{samples * _BYTES_PER_SAMPLE / 1e9:.3g} GB; at most {MAX_SAMPLES} are run: shorten "
        "duration or lengthen "
        "sample_time",
    )
    require(
        scenario.num_control_periods >= 1,
        "sample_time",
        f"must be at most duration ({scenario.duration} s)",
    )
    require(scenario.divergence_speed > 0, "divergence_speed", "must be > 0")
    duration, reserve = scenario.reference.duration, scenario.reference.reserve
    require(duration is None or duration > 0, "reference.duration", "must be > 0 s, or auto")
    require(0 <= reserve < 1, "reference.reserve", f"must be from 0 to below 1, not {reserve:g}")
    require(bool(_NAME.fullmatch(scenario.controller)), "controller", _form(scenario.controller))
    blocks = scenario.blocks
    filled = {name: getattr(blocks, name) for name in ("reference", "sensing", "actuation")}
    filled |= {f"forces.{name}": block for name, block in blocks.forces.items()}
    for name, block in filled.items():
        if block is not None:
            require(
                bool(_NAME.fullmatch(block.system)), f"blocks.{name}.system", _form(block.system)
            )
    for name in blocks.forces:
        require(
            name.isidentifier(),
            f"blocks.forces.{name}",
            "a force's name must be letters, digits and underscores",
        )
    for key, kind, kinds in (
        ("reference.kind", scenario.reference.kind, REFERENCE_KINDS),
        ("reference.base_rotation", scenario.reference.base_rotation, BASE_ROTATIONS),
        ("reference.goal", scenario.reference.goal, GOALS),
        ("estimator.kind", scenario.estimator.kind, ESTIMATOR_KINDS),
    ):
        _require_choice(kind, key, kinds)
    if scenario.reference.shaper is not None:
        _validate_shaper(scenario.reference.shaper, scenario.reference.kind)
    _validate_planning(scenario)
    for name in ("walk", "force_walk"):
        for key, number in getattr(scenario.estimator, name).items():
            require(number > 0, f"estimator.{name}.{key}", f"must be > 0, not {number}")
    for name in ("position_noise", "velocity_noise", "velocity_bias_walk"):
        for key, number in (getattr(scenario.estimator, name) or {}).items():
            require(
                number >= 0,
                f"estimator.{name}.{key}",
                f"a standard deviation must be >= 0, not {number}",
            )
    for key, number in scenario.tolerance.items():
        require(number > 0, f"tolerance.{key}", f"must be > 0, not {number}")
    for name in ("low_pass", "notch"):
        for key, number in getattr(scenario.command_filter, name).items():
            require(
                number >= 0,
                f"command_filter.{name}.{key}",
                f"must be >= 0 Hz (0: none), not {number:g}",
            )
    for key, number in scenario.command_filter.notch_width.items():
        require(number > 0, f"command_filter.notch_width.{key}", f"must be > 0, not {number:g}")
    _validate_simulator_config(scenario)
    for name, part in scenario.model.flexible.items():
        _validate_flexible(part, f"model.flexible.{name}")
        problem = (
            "is the target, of which nothing can be flexible before it is held; leave "
            "capture.approach out"
        )
        held = (
            scenario.grasp_time == 0.0
            or part.kind in ("joint", "gear")
            or part.body != scenario.payload.body
        )
        require(held, f"model.flexible.{name}.body", f"'{part.body}' {problem}")
        drives = scenario.actuation.drives
        rotors = {} if drives is None else drives.rotor_inertia or {}
        rotor = next((rotors[key] for key in (part.joint, "joints", "all") if key in rotors), 0.0)
        turns = (
            f"give that of {part.joint}, > 0 kg m^2: it is what the drive turns against the "
            f"spring of '{name}'"
        )
        require(part.kind != "gear" or rotor > 0, "actuation.drives.rotor_inertia", turns)
    for name in ("truth", "nominal"):
        _validate_mass_properties(getattr(scenario.payload, name), f"payload.{name}")
    for name, posture in scenario.postures.items():
        _validate_posture(posture, name)
    if scenario.capture is not None:
        _validate_capture(scenario, scenario.capture)
    for key, number in scenario.initial_velocity.items():
        require(
            abs(number) <= scenario.divergence_speed,
            f"initial_velocity.{key}",
            f"must be within divergence_speed ({scenario.divergence_speed:g}), not {number}",
        )
    require(
        scenario.disturbance.frequency_scale >= 0, "disturbance.frequency_scale", "must be >= 0"
    )
    if scenario.environment is not None:
        _validate_environment(scenario.environment)
    sensing = scenario.sensing
    for name in (
        "velocity_noise",
        "position_noise",
        "velocity_correlated_noise",
        "position_correlated_noise",
        "velocity_bias_walk",
    ):
        for key, number in getattr(sensing, name).items():
            require(
                number >= 0,
                f"sensing.{name}.{key}",
                f"a standard deviation must be >= 0, not {number}",
            )
    for key, number in sensing.correlation_time.items():
        require(number > 0, f"sensing.correlation_time.{key}", f"must be > 0 s, not {number}")
    for name, least in (
        ("velocity_period", 1),
        ("position_period", 1),
        ("velocity_delay", 0),
        ("position_delay", 0),
    ):
        for key, number in getattr(sensing, name).items():
            whole = (
                f"must be a whole number of control samples from {least} to {MAX_DELAY}, not "
                f"{number:g}"
            )
            require(
                least <= number <= MAX_DELAY and number == round(number),
                f"sensing.{name}.{key}",
                whole,
            )
    for name in ("velocity_quantization", "position_quantization"):
        for key, number in getattr(sensing, name).items():
            require(number >= 0, f"sensing.{name}.{key}", f"must be >= 0 (0: none), not {number}")
    for key, number in (scenario.actuation.limit or {}).items():
        require(number > 0, f"actuation.limit.{key}", f"must be > 0, not {number}")
    for key, number in scenario.actuation.quantization.items():
        require(
            number >= 0, f"actuation.quantization.{key}", f"must be >= 0 (0: none), not {number}"
        )
    for place in ("sensing", "actuation", "estimator"):
        delay = getattr(scenario, place).delay or 0
        problem = f"must be from 0 to {MAX_DELAY} control samples, not {delay}"
        require(0 <= delay <= MAX_DELAY, f"{place}.delay", problem)
    _validate_driven(scenario)
    if scenario.reference.frame is not None:
        _validate_frame(scenario, scenario.reference.frame)
    if scenario.actuation.thrusters is not None:
        _validate_thrusters(scenario.actuation.thrusters, scenario.sample_time)
    if scenario.actuation.wheels is not None:
        _validate_wheels(scenario.actuation.wheels)
    if scenario.actuation.drives is not None:
        _validate_drives(scenario.actuation.drives)


def _validate_driven(scenario: Scenario) -> None:
    key, given = "actuation.driven", scenario.actuation.driven
    sound = given == ["all"] or (len(set(given)) == len(given) and set(given) in map(set, DRIVEN))
    choices = " or ".join(f"[{', '.join(groups)}]" for groups in DRIVEN[1:])
    require(sound, key, f"must be all, {choices}, not {shown(given)}")
    undriven, actuation = scenario.undriven, scenario.actuation
    if not undriven:
        return
    for kind, group in (("thrusters", "base_position"), ("wheels", "base_rotation")):
        without = (
            f"{', '.join(undriven)}: {kind} cannot act; leave actuation.{kind} out, or have "
            f"{group} driven"
        )
        require(
            getattr(actuation, kind) is None or group in scenario.driven,
            key,
            f"leaves out {without}",
        )
    first, last = scenario.initial_posture, scenario.target_posture
    for group, field in (("base_rotation", "base_rpy"), ("base_position", "base_position")):
        asked = group in undriven and getattr(first, field) != getattr(last, field)
        where = (
            f"{group} is not driven (actuation.driven) and goes nowhere by command: give the "
            "initial posture's"
        )
        require(scenario.reference.goal == "stop" or not asked, f"target_posture.{field}", where)
    approach = scenario.capture is not None and scenario.capture.approach is not None
    require(
        not approach,
        "capture.approach",
        "needs every coordinate driven (actuation.driven); leave it out",
    )


def _validate_frame(scenario: Scenario, frame: FrameGoal) -> None:
    key, reference = "reference.frame", scenario.reference
    require(
        reference.kind != "optimal",
        key,
        "has no effect on a plan; take kind quintic or septic, or frame: null",
    )
    approach = scenario.capture is not None and scenario.capture.approach is not None
    require(not approach, "capture.approach", "needs reference.frame: null; leave one of them out")
    for name, choice, choices in (
        ("task", frame.task, FRAME_TASKS),
        ("priority", frame.priority, FRAME_PRIORITIES),
        ("joints", frame.joints, FRAME_JOINTS),
    ):
        _require_choice(choice, f"{key}.{name}", choices)
    for name, given, other in (
        ("position", frame.position, "attitude"),
        ("rpy", frame.rpy, "position"),
    ):
        require(
            given is None or len(given) == 3, f"{key}.{name}", "must hold three numbers, or be null"
        )
        unused = given is None or frame.task not in (other, "none")
        require(unused, f"{key}.{name}", f"has no effect with task: {frame.task}; leave it out")
        stops = given is None or reference.goal != "stop"
        require(
            stops,
            f"{key}.{name}",
            "has no effect with goal: stop, which ends wherever it can; leave it out",
        )
    undriven = [
        name
        for group in scenario.undriven
        for name in (group, *(f"{group}_{axis}" for axis in "xyz"))
    ]
    for name in frame.hold:
        known = (
            f"choose of {', '.join(undriven)}{did_you_mean(name, undriven)}"
            if undriven
            else "leave it out"
        )
        require(
            name in undriven,
            f"{key}.hold",
            f"'{name}' is no base coordinate that is left undriven; {known}",
        )
    require(frame.damping > 0, f"{key}.damping", f"must be > 0, not {frame.damping:g}")
    require(
        0 <= frame.feedback <= 100,
        f"{key}.feedback",
        f"must be from 0 to 100 1/s, not {frame.feedback:g}",
    )


def _validate_drives(drives: Drives) -> None:
    for field in dataclasses.fields(drives):
        for key, number in (getattr(drives, field.name) or {}).items():
            place = f"actuation.drives.{field.name}.{key}"
            if field.name in ("gear_ratio", "rate_limit", "stribeck_rate", "smoothing_rate"):
                require(number > 0, place, f"must be > 0, not {number:g}")
            elif field.name == "knee":
                require(0 <= number < 1, place, f"must be from 0 to below 1, not {number:g}")
            else:
                require(number >= 0, place, f"must be >= 0, not {number:g}")


def _validate_flexible(part: Flexible, key: str) -> None:
    name = key.rpartition(".")[2]
    require(name.isidentifier(), key, "a part's name must be letters, digits and underscores")
    _require_choice(part.kind, f"{key}.kind", FLEXIBLE_KINDS)
    for vector in ("position", "direction", "axis"):
        require(
            len(getattr(part, vector)) == 3, f"{key}.{vector}", "must hold three numbers [x, y, z]"
        )
    for vector in ("direction", "axis"):
        require(
            bool(np.linalg.norm(getattr(part, vector)) > 1e-9),
            f"{key}.{vector}",
            "must not be zero",
        )
    along, axis = (np.array(each) / np.linalg.norm(each) for each in (part.direction, part.axis))
    across = part.kind in ("mass", "joint", "gear") or abs(along @ axis) < 1e-6
    require(across, f"{key}.axis", f"must be across direction {part.direction}, not {part.axis}")
    for size in ("mass", "length", "width"):
        require(
            getattr(part, size) > 0, f"{key}.{size}", f"must be > 0, not {getattr(part, size):g}"
        )
    require(
        1 <= part.plates <= MAX_PLATES,
        f"{key}.plates",
        f"must be from 1 to {MAX_PLATES}, not {part.plates}",
    )
    of_joint = part.kind in ("joint", "gear")
    require(
        of_joint == (part.joint is not None),
        f"{key}.joint",
        (
            "name the joint of the model"
            if of_joint
            else f"has no effect on a {part.kind}; leave it out"
        ),
    )
    if part.kind == "beam":
        given = part.frequency is None and part.stiffness is None
        require(given, f"{key}.frequency", "a beam takes frequencies, of its modes; leave it out")
        count = f"give the frequencies of 1 to {MAX_MODES} modes, Hz"
        require(1 <= len(part.frequencies) <= MAX_MODES, f"{key}.frequencies", count)
    else:
        require(
            not part.frequencies,
            f"{key}.frequencies",
            f"are of a beam; a {part.kind} takes frequency",
        )
        one = (part.frequency is None) != (part.stiffness is None)
        require(one, f"{key}.frequency", "give either frequency (Hz) or stiffness")
    for number in (*part.frequencies, *((part.frequency,) if part.frequency is not None else ())):
        require(number > 0, f"{key}.frequency", f"must be > 0 Hz, not {number:g}")
    require(part.stiffness is None or part.stiffness > 0, f"{key}.stiffness", "must be > 0")
    require(
        0 <= part.damping_ratio < 1,
        f"{key}.damping_ratio",
        f"must be from 0 to below 1, not {part.damping_ratio}",
    )


def _validate_shaper(shaper: Shaper, kind: str) -> None:
    key = "reference.shaper"
    require(
        kind != "optimal",
        key,
        "has no effect on a plan; take kind quintic or septic, or shaper: null",
    )
    _require_choice(shaper.kind, f"{key}.kind", SHAPER_KINDS)
    count = f"give 1 to {MAX_SHAPED} frequencies in Hz, not {len(shaper.frequencies)}"
    require(1 <= len(shaper.frequencies) <= MAX_SHAPED, f"{key}.frequencies", count)
    for number in shaper.frequencies:
        require(
            0 < number <= 1e3, f"{key}.frequencies", f"must be > 0, at most 1000 Hz, not {number:g}"
        )
    ratio = shaper.damping_ratio
    require(0 <= ratio < 1, f"{key}.damping_ratio", f"must be from 0 to below 1, not {ratio:g}")


def _validate_environment(environment: Environment) -> None:
    key, altitude, rate = "environment", environment.altitude, environment.mean_motion
    if rate is not None:
        require(
            0 < rate <= MAX_MEAN_MOTION,
            f"{key}.mean_motion",
            f"must be > 0, at most 0.01 rad/s, not {rate:g}",
        )
        require(
            altitude is None,
            f"{key}.altitude",
            "has no effect beside a mean_motion; set altitude: null",
        )
    else:
        require(altitude is not None, f"{key}.altitude", "give a number of metres, or mean_motion")
        require(
            0 < (altitude or 0.0) <= 1e9,
            f"{key}.altitude",
            f"must be > 0, at most 1e9 m, not {altitude:g}",
        )
    require(
        len(environment.hill_rpy) == 3,
        f"{key}.hill_rpy",
        "must hold three numbers [roll, pitch, yaw]",
    )
    solar = environment.solar_pressure
    if solar is not None:
        key = f"{key}.solar_pressure"
        for name in ("area", "coefficient", "pressure"):
            require(
                getattr(solar, name) >= 0,
                f"{key}.{name}",
                f"must be >= 0, not {getattr(solar, name):g}",
            )
        for name in ("sun", "center_of_pressure"):
            require(
                len(getattr(solar, name)) == 3, f"{key}.{name}", "must hold three numbers [x, y, z]"
            )
        require(bool(np.linalg.norm(solar.sun) > 1e-9), f"{key}.sun", "must not be zero")


def _validate_wheels(wheels: Wheels) -> None:
    key = "actuation.wheels"
    require(
        bool(wheels.units), f"{key}.units", "give wheels by name, such as {z: {axis: [0, 0, 1]}}"
    )
    require(
        len(wheels.units) <= MAX_WHEELS,
        f"{key}.units",
        f"at most {MAX_WHEELS}, not {len(wheels.units)}",
    )
    for name, unit in wheels.units.items():
        place = f"{key}.units.{name}"
        require(len(unit.axis) == 3, f"{place}.axis", "must hold three numbers [x, y, z]")
        require(bool(np.linalg.norm(unit.axis) > 1e-9), f"{place}.axis", "must not be zero")
        for part in ("inertia", "torque_limit", "speed_limit"):
            require(
                getattr(unit, part) > 0,
                f"{place}.{part}",
                f"must be > 0, not {getattr(unit, part):g}",
            )
        for part in ("coulomb_friction", "viscous_friction"):
            require(
                getattr(unit, part) >= 0,
                f"{place}.{part}",
                f"must be >= 0, not {getattr(unit, part):g}",
            )
        largest = unit.inertia * unit.speed_limit
        within = (
            f"must be within inertia * speed_limit, {largest:.4g} N m s, not "
            f"{unit.initial_momentum:g}"
        )
        require(abs(unit.initial_momentum) <= largest, f"{place}.initial_momentum", within)
    above, below = wheels.desaturate_above, wheels.desaturate_below
    require(0 < above <= 1, f"{key}.desaturate_above", f"must be above 0, at most 1, not {above:g}")
    problem = f"must be from 0 to below desaturate_above ({above:g}), not {below:g}"
    require(0 <= below < above, f"{key}.desaturate_below", problem)
    time = wheels.desaturation_time
    require(time > 0, f"{key}.desaturation_time", f"must be > 0 s, not {time:g}")
    if (assist := wheels.assist_above) is not None:
        require(assist >= 1, f"{key}.assist_above", f"must be null or at least 1, not {assist:g}")


def _validate_thrusters(thrusters: Thrusters, sample_time: float) -> None:
    key, layouts = "actuation.thrusters", tuple(thruster_layouts())
    if thrusters.layout is not None:
        _require_choice(thrusters.layout, f"{key}.layout", layouts)
        require(
            not thrusters.units, f"{key}.units", "has no effect beside a layout; set layout: null"
        )
    require(
        bool(thrusters_of(thrusters)),
        f"{key}.layout",
        f"choose one of {', '.join(layouts)}, or give units",
    )
    many = f"at most {MAX_THRUSTERS} thrusters are allocated, not {len(thrusters.units)}"
    require(len(thrusters.units) <= MAX_THRUSTERS, f"{key}.units", many)
    for name, unit in thrusters.units.items():
        place = f"{key}.units.{name}"
        for part in ("position", "direction"):
            require(
                len(getattr(unit, part)) == 3,
                f"{place}.{part}",
                "must hold three numbers [x, y, z]",
            )
        require(
            bool(np.linalg.norm(unit.direction) > 1e-9), f"{place}.direction", "must not be zero"
        )
        require(unit.force > 0, f"{place}.force", f"must be > 0 N, not {unit.force:g}")
        require(
            unit.specific_impulse > 0,
            f"{place}.specific_impulse",
            f"must be > 0 s, not {unit.specific_impulse:g}",
        )
    names = tuple(thrusters_of(thrusters))
    for name, failure in thrusters.failures.items():
        _require_choice(name, f"{key}.failures.{name}", names)
        _require_choice(failure, f"{key}.failures.{name}", THRUSTER_FAILURES)
    _require_choice(thrusters.modulator, f"{key}.modulator", MODULATORS)
    for part in ("minimum_on_time", "rise_time", "fall_time"):
        number = getattr(thrusters, part)
        require(0 <= number <= 1e3, f"{key}.{part}", f"must be from 0 to 1000 s, not {number:g}")
    threshold = f"must be from 0.5 to below 1, not {thrusters.threshold:g}"
    require(0.5 <= thrusters.threshold < 1, f"{key}.threshold", threshold)
    frame = f"must be from 1 to {MAX_FRAME} control samples, not {thrusters.frame}"
    require(1 <= thrusters.frame <= MAX_FRAME, f"{key}.frame", frame)
    require(
        thrusters.modulator == "pwpf"
        or thrusters.frame * sample_time >= thrusters.minimum_on_time * (1 - 1e-9),
        f"{key}.frame",
        f"{thrusters.frame} control samples are {thrusters.frame * sample_time:g} s, shorter than "
        "minimum_on_time, "
        f"{thrusters.minimum_on_time:g} s; take "
        f"{math.ceil(thrusters.minimum_on_time / sample_time - 1e-9)} or more",
    )
    pwpf = thrusters.pwpf
    for part in ("gain", "time_constant", "on"):
        require(
            getattr(pwpf, part) > 0,
            f"{key}.pwpf.{part}",
            f"must be > 0, not {getattr(pwpf, part):g}",
        )
    require(
        0 <= pwpf.off < pwpf.on,
        f"{key}.pwpf.off",
        f"must be from 0 to below on ({pwpf.on:g}), not {pwpf.off:g}",
    )


def _validate_planning(scenario: Scenario) -> None:
    planning, reference = scenario.planning, scenario.reference
    require(
        reference.kind != "optimal" or bool(reference.plan),
        "reference.plan",
        "name the plan's file, such as mine.plan.yaml, which 'ffsm plan' writes, or set "
        "reference.kind to quintic",
    )
    require(scenario.clearance >= 0, "clearance", f"must be >= 0 m, not {scenario.clearance:g}")
    for name in ("time_weight", "effort_weight", "end_rate"):
        require(
            getattr(planning, name) >= 0,
            f"planning.{name}",
            f"must be >= 0, not {getattr(planning, name):g}",
        )
    weighed = planning.time_weight + planning.effort_weight > 0
    require(weighed, "planning.time_weight", "must be > 0 where effort_weight is 0")
    require(
        0 <= planning.reserve < 1,
        "planning.reserve",
        f"must be from 0 to below 1, not {planning.reserve:g}",
    )
    turn = planning.base_attitude_limit
    require(
        turn is None or turn > 0, "planning.base_attitude_limit", f"must be > 0 rad, not {turn}"
    )
    fit = MIN_SEGMENTS <= planning.segments <= MAX_SEGMENTS
    problem = f"must be from {MIN_SEGMENTS} to {MAX_SEGMENTS}, not {planning.segments}"
    require(fit, "planning.segments", problem)
    for name in ("velocity_limit", "impulse_limit"):
        for key, number in (getattr(planning, name) or {}).items():
            require(number > 0, f"planning.{name}.{key}", f"must be > 0, not {number}")


def _form(name: str) -> str:
    return f"'{name}' must be a name or module:attribute"


def _require_choice(choice: str, key: str, valid: tuple[str, ...]) -> None:
    problem = (
        f"'{choice}' is unknown; choose one of {', '.join(valid)}{did_you_mean(choice, valid)}"
    )
    require(choice in valid, key, problem)


def _validate_posture(posture: Posture, key: str) -> None:
    for name in ("base_position", "base_rpy"):
        require(
            len(getattr(posture, name)) == 3, f"{key}.{name}", "must hold three numbers [x, y, z]"
        )


def _validate_capture(scenario: Scenario, capture: Capture) -> None:
    for name in ("rate", "velocity"):
        values = getattr(capture, name)
        require(len(values) == 3, f"capture.{name}", "must hold three numbers [x, y, z]")
        fastest = max(map(abs, values))
        bound = f"must be within divergence_speed ({scenario.divergence_speed:g}), not {fastest:g}"
        require(fastest <= scenario.divergence_speed, f"capture.{name}", bound)
    for key, choice, valid in (
        ("axes", capture.axes, CAPTURE_AXES),
        ("servicer", capture.servicer, SERVICER_MOTIONS),
        ("joints", capture.joints, GRASPING_JOINTS),
    ):
        _require_choice(choice, f"capture.{key}", valid)
    given = capture.servicer == "given" or not any(capture.servicer_velocity.values())
    require(
        given,
        "capture.servicer_velocity",
        f"has no effect with servicer: {capture.servicer}; take servicer: given",
    )
    require(
        capture.tracking_length > 0,
        "capture.tracking_length",
        f"must be > 0 m, not {capture.tracking_length}",
    )
    for key, number in capture.tracking_cost.items():
        require(number > 0, f"capture.tracking_cost.{key}", f"must be > 0, not {number}")
    require(
        scenario.reference.base_rotation == "eigenaxis",
        "reference.base_rotation",
        f"must be eigenaxis with capture, not {scenario.reference.base_rotation}: the base may "
        "turn at the start",
    )
    for field in dataclasses.fields(capture.compliance) if capture.compliance is not None else ():
        number = getattr(capture.compliance, field.name)
        require(number > 0, f"capture.compliance.{field.name}", f"must be > 0, not {number:g}")
    for group, number in (capture.accepted_drift or {}).items():
        key, most = (
            f"capture.accepted_drift.{group}",
            math.pi if group == "base_rotation" else math.inf,
        )
        known = f"choose of {', '.join(scenario.undriven)}" if scenario.undriven else "leave it out"
        require(
            group in scenario.undriven,
            key,
            f"'{group}' is not what actuation.driven leaves undriven; {known}",
        )
        require(
            0.0 < number < most,
            key,
            f"must be > 0{' and below pi' if most < math.inf else ''}, not {number:g}",
        )
    if capture.approach is not None:
        duration, key = capture.approach.duration, "capture.approach.duration"
        samples = duration / scenario.sample_time
        require(
            samples >= 0.5 and abs(samples - round(samples)) < 1e-6,
            key,
            f"must be a whole number of control samples of {scenario.sample_time:g} s, not "
            f"{duration:g} s",
        )
        require(
            duration <= scenario.duration - scenario.sample_time,
            key,
            f"must leave time for the stop: the run ends at {scenario.duration:g} s; lengthen "
            "duration",
        )


def _validate_simulator_config(scenario: Scenario) -> None:
    # Drake's "cenic" wants the plant at the top of the diagram.
    config, schemes = (
        scenario.simulator_config,
        [name for name in GetIntegrationSchemes() if name != "cenic"],
    )
    require(
        config.integration_scheme in schemes,
        "simulator_config.integration_scheme",
        f"'{config.integration_scheme}' is unknown; choose one of {', '.join(schemes)}"
        + did_you_mean(config.integration_scheme, schemes),
    )
    require(
        not config.use_error_control or config.integration_scheme not in FIXED_STEP_SCHEMES,
        "simulator_config.use_error_control",
        f"{config.integration_scheme} has no error estimate; set false, or choose another "
        "integration_scheme",
    )
    require(config.accuracy > 0, "simulator_config.accuracy", f"must be > 0, not {config.accuracy}")
    require(
        config.target_realtime_rate >= 0,
        "simulator_config.target_realtime_rate",
        "must be >= 0 (0: no pacing)",
    )
    require(
        config.start_time == 0,
        "simulator_config.start_time",
        "must be 0: every run starts there; leave it out",
    )
    require(config.max_step_size > 0, "simulator_config.max_step_size", "must be > 0 s")
    steps = scenario.duration / config.max_step_size
    require(
        steps <= MAX_STEPS,
        "simulator_config.max_step_size",
        f"{config.max_step_size:g} s gives {steps:.3g} steps in {scenario.duration:g} s; at most "
        f"{MAX_STEPS} are run",
    )


def _validate_mass_properties(body: MassProperties, key: str) -> None:
    require(body.mass > 0, f"{key}.mass", f"must be > 0 kg, not {body.mass}")
    require(
        len(body.center_of_mass) == 3, f"{key}.center_of_mass", "must hold three numbers [x, y, z]"
    )
    require(
        len(body.inertia) in (3, 6),
        f"{key}.inertia",
        "must hold three moments [Ixx, Iyy, Izz], or those and three products [Ixy, Ixz, Iyz]",
    )
    try:
        with np.errstate(all="ignore"):
            principal = np.linalg.eigvalsh(inertia_matrix(body))
    except np.linalg.LinAlgError:
        principal = np.full(3, np.nan)
    require(
        bool(np.isfinite(principal).all()),
        f"{key}.inertia",
        f"has no principal moments: {shown(body.inertia)}",
    )
    require(bool(principal[0] > 0), f"{key}.inertia", "must be positive definite")
    require(
        bool(principal[0] + principal[1] >= principal[2] * (1 - 1e-12)),
        f"{key}.inertia",
        f"principal moments {np.round(principal, 6).tolist()} violate the triangle inequality "
        "(the largest must not exceed the sum of the others)",
    )


def require(condition: bool, key: str, problem: str) -> None:
    if not condition:
        raise ScenarioError(key, problem)
