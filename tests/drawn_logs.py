"""Logs of drawn craft for ``ffsm audit``: true ones, by MuJoCo and by SciPy on Drake's plant, and
ones with a mistake of drawn size.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ffsm_drake.common.numbers import counted
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.plant import make_plant

Columns = dict[str, np.ndarray]
POSITION = [f"base_position_{x}" for x in "xyz"]
QUATERNION = [f"base_quaternion_{x}" for x in "wxyz"]
LINEAR = [f"base_velocity_{x}" for x in "xyz"]
ANGULAR = [f"base_angular_velocity_{x}" for x in "xyz"]


@dataclasses.dataclass(frozen=True)
class Craft:
    """A base with an arm whose links stand on each other."""

    urdf: str
    joints: tuple[str, ...]

    def names(self, end: str = "") -> list[str]:
        return [name + end for name in self.joints]


@functools.cache
def craft(seed: int, joints: int) -> Craft:
    """A drawn craft: 60 to 600 kg, an arm of 1 to 15 % of that."""
    draw = np.random.default_rng([seed, joints])
    mass = draw.uniform(60.0, 600.0)
    sides = draw.uniform(0.8, 1.8, 3)
    inertia = mass / 12.0 * (np.sum(sides**2) - sides**2)
    links = [_link("base", mass, draw.uniform(-0.05, 0.05, 3), inertia)]
    names, place = [], [0.5 * sides[0], *draw.uniform(-0.3, 0.3, 2)]
    for i in range(joints):
        length, weight = draw.uniform(0.25, 0.7), mass * draw.uniform(0.01, 0.15) / joints
        along = weight * length**2 / 12.0
        own = np.array([0.05 * weight * 0.1, along, along]) + 0.002 * weight
        links.append(_link(f"link_{i}", weight, np.array([0.5 * length, 0.01, 0.0]), own))
        axis = np.eye(3)[draw.permutation(3)[0]] if draw.random() < 0.7 else draw.normal(size=3)
        names.append(f"hinge_{i}")
        links.append(
            f'<joint name="hinge_{i}" type="continuous"><parent link="'
            f'{"base" if i == 0 else f"link_{i - 1}"}"/><child link="link_{i}"/>'
            f'<origin xyz="{_text(place)}"/>'
            f'<axis xyz="{_text(axis / np.linalg.norm(axis))}"/></joint>'
        )
        place = [length, 0.0, 0.0]
    return Craft(f'<robot name="drawn">{"".join(links)}</robot>', tuple(names))


def _text(values) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _link(name: str, mass: float, center, inertia) -> str:
    xx, yy, zz = inertia
    return (
        f'<link name="{name}"><inertial><origin xyz="{_text(center)}"/><mass value="{mass:.9g}"/>'
        f'<inertia ixx="{xx:.9g}" iyy="{yy:.9g}" izz="{zz:.9g}" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link>"
    )


def efforts_of(count: int, seed: int, size: float = 1.0):
    """Torques (count) over time: sums of sines that swing an arm by about a radian."""
    draw = np.random.default_rng([7, seed])
    rate = draw.uniform(0.6, 2.5, count)
    phase = draw.uniform(0.0, 6.0, count)
    return lambda t: size * np.cos(rate * t + phase)


def first_state(count: int, seed: int, spin: float) -> tuple[np.ndarray, np.ndarray]:
    """Configuration (quaternion, position, joints) and velocity (w in base axes, v, joints)."""
    draw = np.random.default_rng([9, seed])
    q = Rotation.random(rng=draw).as_quat(scalar_first=True)
    w = draw.normal(size=3)
    rates = 0.1 * draw.uniform(-1.0, 1.0, count)
    return (
        np.concatenate([q, draw.uniform(-0.5, 0.5, 3), draw.uniform(-1.0, 1.0, count)]),
        np.concatenate([spin * w / np.linalg.norm(w), 0.03 * draw.normal(size=3), rates]),
    )


def columns_of(craft: Craft, time, q, v, efforts) -> Columns:
    """Columns from q (quaternion, position, joints) and v (w, v, joints), rows of samples."""
    names = [*QUATERNION, *POSITION, *craft.joints, *ANGULAR, *LINEAR, *craft.names("_rate")]
    named = dict(zip(names, np.hstack([q, v]).T, strict=True))
    more = dict(zip(craft.names("_effort"), np.asarray(efforts).T, strict=True))
    return {"time": np.asarray(time)} | named | more


def reflected(craft: Craft, seed: int) -> np.ndarray:
    """Inertia (joints) of what each joint moves, for torques in proportion."""
    model = compiled(craft)
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([[0.0] * 3, [1.0, 0.0, 0.0, 0.0], [0.4] * len(craft.joints)])
    mujoco.mj_forward(model, data)
    full = np.stack([_product(model, data, column) for column in np.eye(model.nv)])
    return np.diag(np.linalg.inv(np.linalg.inv(full)[6:, 6:]))


def _product(model, data, vector) -> np.ndarray:
    found = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, found, vector)
    return found


def compiled(craft: Craft, heavier: tuple[int, float] | None = None) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(craft.urdf)
    spec.compiler.fusestatic = False
    spec.body("base").add_freejoint()
    if heavier:
        body = spec.bodies[heavier[0]]
        body.mass *= heavier[1]
        body.inertia *= heavier[1]
    spec.option.gravity = [0.0, 0.0, 0.0]
    return spec.compile()


def by_mujoco(
    craft: Craft,
    seed: int,
    *,
    period: float = 0.01,
    step: float = 0.002,
    duration: float = 5.0,
    spin: float = 0.1,
    size: float = 0.3,
    integrator: str = "RK4",
    heavier: tuple[int, float] | None = None,
    change: Callable[[mujoco.MjModel], None] = lambda _: None,
    push: Callable[[float], np.ndarray] | None = None,
) -> Columns:
    """Angular velocities in base axes; torques held from each sample on."""
    model = compiled(craft, heavier)
    model.opt.timestep = step
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    change(model)
    data, count = mujoco.MjData(model), len(craft.joints)
    q, v = first_state(count, seed, spin)
    data.qpos[:] = np.concatenate([q[4:7], q[:4], q[7:]])
    data.qvel[:] = np.concatenate([v[3:6], v[:3], v[6:]])
    torque, scale = efforts_of(count, seed, size), reflected(craft, seed)
    rows = []
    for k in range(round(duration / period) + 1):
        effort = torque(k * period) * scale
        data.qfrc_applied[6:] = effort
        if push:
            data.qfrc_applied[:6] = push(k * period)
        rows.append([k * period, *data.qpos, *data.qvel, *effort])
        for _ in range(round(period / step)):
            mujoco.mj_step(model, data)
    table, end = np.array(rows), 8 + count
    q = np.hstack([table[:, 4:8], table[:, 1:4], table[:, 8:end]])
    v = np.hstack(
        [table[:, end + 3 : end + 6], table[:, end : end + 3], table[:, end + 6 : -count]]
    )
    v = v if count else np.hstack([table[:, 11:14], table[:, 8:11]])
    return columns_of(craft, table[:, 0], q, v, table[:, len(table[0]) - count :])


def by_scipy(
    craft: Craft,
    seed: int,
    folder: Path,
    *,
    period: float | None = 0.02,
    duration: float = 8.0,
    spin: float = 0.1,
    size: float = 0.3,
    accuracy: float = 1e-10,
) -> Columns:
    """Smooth torques on Drake's plant, by DOP853; without a period at the solver's own steps.
    Angular velocities in world axes.
    """
    path = folder / f"craft_{seed}_{len(craft.joints)}.urdf"
    path.write_text(craft.urdf)
    model = Model(directives=str(path), end_effector="WorldModelInstance::world")
    plant, count = make_plant(model, jointless=True), len(craft.joints)
    context, nq = plant.CreateDefaultContext(), 7 + count
    torque = efforts_of(count, seed, size)
    scale = reflected(craft, seed) if count else np.zeros(0)

    def rate(t, x):
        x = np.concatenate([x[:4] / np.linalg.norm(x[:4]), x[4:]])
        plant.SetPositionsAndVelocities(context, x)
        force = np.concatenate([np.zeros(6), torque(t) * scale]) - plant.CalcBiasTerm(context)
        a = np.linalg.solve(plant.CalcMassMatrix(context), force)
        return np.concatenate([plant.MapVelocityToQDot(context, x[nq:]), a])

    q, v = first_state(count, seed, spin)
    v[:3] = Rotation.from_quat(q[:4], scalar_first=True).apply(v[:3])
    times = None if period is None else np.linspace(0.0, duration, round(duration / period) + 1)
    found = solve_ivp(
        rate, (0.0, duration), np.concatenate([q, v]), t_eval=times, rtol=accuracy,
        atol=0.01 * accuracy, method="RK45" if period is None else "DOP853",
    )  # fmt: skip
    rows = found.y.T
    rows[:, :4] /= np.linalg.norm(rows[:, :4], axis=1, keepdims=True)
    efforts = np.array([torque(t) * scale for t in found.t])
    return columns_of(craft, found.t, rows[:, :nq], rows[:, nq:], efforts)


def attitude(log: Columns) -> Rotation:
    return Rotation.from_quat(rows(log, QUATERNION), scalar_first=True)


def rows(log: Columns, names: list[str]) -> np.ndarray:
    return np.stack([log[name] for name in names], axis=1)


def put(log: Columns, names: list[str], values: np.ndarray) -> Columns:
    return log | dict(zip(names, np.asarray(values).T, strict=True))


def scaled(log: Columns, factor: float, names: list[str]) -> Columns:
    return log | {name: factor * log[name] for name in names}


def added(log: Columns, name: str, value) -> Columns:
    return log | {name: log[name] + value}


def world_rates(log: Columns) -> Columns:
    """Of a log whose angular velocities are in base axes."""
    return put(log, ANGULAR, attitude(log).apply(rows(log, ANGULAR)))


def body_velocity(log: Columns) -> Columns:
    return put(log, LINEAR, attitude(log).inv().apply(rows(log, LINEAR)))


def in_turning_frame(log: Columns, rate: np.ndarray) -> Columns:
    """Of a log with angular velocities in world axes."""
    back = Rotation.from_rotvec(-log["time"][:, None] * rate)
    place, turn = rows(log, POSITION), attitude(log)
    log = put(log, LINEAR, back.apply(rows(log, LINEAR) - np.cross(rate, place)))
    log = put(log, ANGULAR, back.apply(rows(log, ANGULAR) - rate))
    log = put(log, POSITION, back.apply(place))
    return put(log, QUATERNION, (back * turn).as_quat(scalar_first=True))


def write(path: Path, log: Columns, form: str = "%.15g") -> Path:
    np.savetxt(
        path, rows(log, list(log)), fmt=form, delimiter=",", header=",".join(log), comments=""
    )
    return path


def true_logs(folder: Path, seed: int = 0) -> dict[str, Path]:
    """Twenty true logs of MuJoCo, and of SciPy on Drake's plant; each has its model beside it."""
    draw, found = np.random.default_rng([45, seed]), dict[str, Path]()

    def add(name: str, made: Craft, log: Columns, form: str = "%.15g") -> None:
        found[name] = write(folder / f"{len(found)}.csv", log, form)
        found[name].with_suffix(".urdf").write_text(made.urdf)

    for joints, period, integrator in (
        (1, 0.01, "RK4"), (3, 0.02, "RK4"), (6, 0.01, "RK4"), (2, 0.05, "RK4"),
        (3, 0.01, "EULER"), (5, 0.01, "EULER"), (2, 0.02, "IMPLICITFAST"),
    ):  # fmt: skip
        made, seed = craft(int(draw.integers(1000)), joints), int(draw.integers(1000))
        spin = draw.uniform(0.05, 0.5)
        log = by_mujoco(made, seed, period=period, integrator=integrator, spin=spin)
        add(f"MuJoCo {integrator}, {counted(joints, 'joint')}, {period} s", made, log)
    made = craft(int(draw.integers(1000)), 3)
    log = by_mujoco(made, int(draw.integers(1000)), spin=0.2)
    add("MuJoCo, rates in world axes, velocity in base axes", made, world_rates(body_velocity(log)))
    add("MuJoCo, four decimals", made, log, "%.4f")
    add("MuJoCo, single precision", made, log, "%.7g")
    noise = {n: 2e-4 * np.random.default_rng(1).normal(size=len(v)) for n, v in log.items()}
    add("MuJoCo, noisy sensors", made, {n: v + (n != "time") * noise[n] for n, v in log.items()})
    add("MuJoCo, without rates", made, {n: v for n, v in log.items() if not n.endswith("_rate")})
    blank = {n: v.copy() for n, v in log.items()}
    for name in made.names() + made.names("_rate") + made.names("_effort"):
        blank[name][::2] = np.nan
    add("MuJoCo, joints at every second row", made, blank)
    for name, options in {
        "coarse: 1 rad/s at 150 ms": {"period": 0.15, "spin": 1.0, "duration": 30.0},
        "coarse: 0.3 rad/s at 500 ms": {"period": 0.5, "spin": 0.3, "duration": 60.0},
        "the solver's own steps": {"period": None, "spin": 0.3},
        "loose steps of the solver": {"period": None, "spin": 0.3, "accuracy": 1e-6},
        "free motion, zero efforts": {"size": 0.0, "spin": 0.3},
        "period 20 ms": {"spin": 0.2},
    }.items():
        made = craft(int(draw.integers(1000)), int(draw.integers(2, 6)))
        add(f"SciPy, {name}", made, by_scipy(made, int(draw.integers(1000)), folder, **options))
    made = craft(int(draw.integers(1000)), 0)
    add("a rigid body, 1 rad/s at 150 ms", made,
        by_scipy(made, 3, folder, period=0.15, spin=1.0, duration=30.0))  # fmt: skip
    return found


def _set(name: str, places: slice, value: float) -> Callable[[mujoco.MjModel], None]:
    return lambda model: getattr(model, name).__setitem__(places, value)


def _tilted(log: Columns, turn: Rotation) -> Columns:
    """Of a log in world axes, with the base's axes turned."""
    return put(log, QUATERNION, (attitude(log) * turn).as_quat(scalar_first=True))


@dataclasses.dataclass(frozen=True)
class Drawn:
    """What a change of a log needs: the craft, one of its joints, random numbers."""

    made: Craft
    joint: str
    draw: np.random.Generator
    sizes: list[float] = dataclasses.field(default_factory=list)  # in the words of an audit

    def even(self, least: float, most: float) -> float:
        return math.exp(self.draw.uniform(math.log(least), math.log(most)))

    def vector(self, size: float) -> np.ndarray:
        found = self.draw.normal(size=3)
        return size * found / np.linalg.norm(found)

    def factor(self) -> float:
        """A factor of a column, whose inverse an audit finds."""
        size = self.even(0.004, 0.15) * self.draw.choice([-1.0, 1.0])
        self.sizes.append(1.0 / (1.0 + size))
        return 1.0 + size

    def offset(self, least: float, most: float) -> np.ndarray:
        """An offset of three columns, which an audit finds."""
        found = self.vector(self.even(least, most))
        self.sizes.extend(found)
        return found


def _exchanged(log: Columns, drawn: Drawn, *ends: str) -> Columns:
    a, b = drawn.made.joints[:2]
    return log | {a + e: log[b + e] for e in ends} | {b + e: log[a + e] for e in ends}


def _late(log: Columns, name: str, samples: int) -> Columns:
    return log | {name: np.concatenate([[log[name][0]] * samples, log[name][:-samples]])}


def _taken(log: Columns, kept: np.ndarray, *, renumbered: bool = False) -> Columns:
    times = {"time": log["time"][: len(kept)]} if renumbered else {}
    return {name: values[kept] for name, values in log.items()} | times


def _without(log: Columns) -> np.ndarray:
    return np.delete(np.arange(len(log["time"])), [50, 51, 80, 120, 121, 122])


def _stale(log: Columns) -> np.ndarray:
    rows = np.arange(len(log["time"]))
    return np.where(np.isin(rows, [30, 70, 110]), rows - 1, rows)


DEGREE = 180.0 / math.pi
# kind of mistake -> what an audit may call it, words that it may use, the changed log
CHANGES: dict[str, tuple[tuple[str, ...], str, Callable[[Columns, Drawn], Columns]]] = {
    "rate scale": (
        ("rate_scale",), "times", lambda log, it: scaled(log, it.factor(), [f"{it.joint}_rate"]),
    ),
    "gyro scale": (("rate_scale",), "times", lambda log, it: scaled(log, it.factor(), ANGULAR)),
    "velocity scale": (("rate_scale",), "times", lambda log, it: scaled(log, it.factor(), LINEAR)),
    "time scale": (("time_scale",), "the time", lambda log, it: scaled(log, it.factor(), ["time"])),
    "milliseconds": (("time_unit",), "milliseconds", lambda log, _: scaled(log, 1e3, ["time"])),
    "all efforts": (
        ("mass_or_effort_scale",), "times the URDF's",
        lambda log, it: scaled(log, it.factor(), it.made.names("_effort")),
    ),
    "effort sign": (
        ("effort_sign",), "other sign", lambda log, it: scaled(log, -1.0, [f"{it.joint}_effort"]),
    ),
    "effort order": (
        ("joint_order",), "the effort called", lambda log, it: _exchanged(log, it, "_effort"),
    ),
    "effort offset": (
        ("effort_offset",), "constant offset",
        lambda log, it: added(log, f"{it.joint}_effort", 0.1 * np.ptp(log[f"{it.joint}_effort"])),
    ),
    "relative rates": (
        ("frame_rate",), "rad/s",
        lambda log, it: put(world_rates(log), ANGULAR,
                            rows(world_rates(log), ANGULAR) - it.offset(1e-3, 1e-2)),
    ),
    "velocity offset": (
        ("rate_offset",), "m/s",
        lambda log, it: put(log, LINEAR, rows(log, LINEAR) - it.offset(1e-3, 1e-1)),
    ),
    "late rate": (("time_shift",), "late", lambda log, it: _late(log, f"{it.joint}_rate", 3)),
    "jump": (
        ("jumps",), "jumps in 1 period",
        lambda log, _: added(log, "base_position_x", 0.05 * (log["time"] > 2.0)),
    ),
    "joint order": (
        ("joint_order", "joint_sign"), "",
        lambda log, it: _exchanged(log, it, "", "_rate", "_effort"),
    ),
    "joint sign": (
        ("joint_sign",), "has the opposite sign",
        lambda log, it: scaled(log, -1.0, [it.joint, f"{it.joint}_rate"]),
    ),
    "rate order": (
        ("joint_order",), "belongs to another joint", lambda log, it: _exchanged(log, it, "_rate"),
    ),
    "joints in degrees": (
        ("degrees",), "every joint is in degrees",
        lambda log, it: scaled(log, DEGREE, it.made.names() + it.made.names("_rate")),
    ),
    "rates in degrees": (
        ("degrees",), "degrees per second",
        lambda log, it: scaled(log, DEGREE, it.made.names("_rate")),
    ),
    "scalar last": (
        ("quaternion_order",), "scalar of the quaternion is last",
        lambda log, _: put(log, QUATERNION, rows(log, [*QUATERNION[1:], QUATERNION[0]])),
    ),
    "inverse": (("quaternion_inverse",), "R_BW", lambda log, _: scaled(log, -1.0, QUATERNION[1:])),
    "norm": (
        ("quaternion_norm",), "1 to 1.02, not 1",
        lambda log, _: put(log, QUATERNION, np.linspace(1.0, 1.02, len(log["time"]))[:, None]
                           * rows(log, QUATERNION)),
    ),
    "velocity turned twice": (
        ("no_single_mistake",), "",
        lambda log, _: body_velocity(body_velocity(log)),
    ),
    "dropped": (("dropped_samples",), "about 6 samples", lambda log, _: _taken(log, _without(log))),
    "dropped and renumbered": (
        ("dropped_samples",), "about 6 samples",
        lambda log, _: _taken(log, _without(log), renumbered=True),
    ),
    "repeated": (
        ("repeated_samples",), "3 samples",
        lambda log, _: _taken(log, _stale(log), renumbered=True),
    ),
    "time order": (
        ("time_order",), "10 samples",
        lambda log, _: _taken(log, np.r_[:100, 90 : len(log["time"])]),
    ),
}  # fmt: skip
# kind of mistake -> what an audit may call it
MISTAKES = {
    "none": (), "zero shift": ("zero_shift",), "spring": ("spring",), "damping": ("friction",),
    "dry friction": ("friction",), "mass": ("mass",), "center": ("center_of_mass",),
    "rotor": ("rotor_inertia",), "effort scale": ("effort_scale",), "frame": ("frame_rate",),
    "gyro bias": ("rate_offset",), "gyro axes": ("axes",), "base axes": ("frame",),
    "force": ("external_force",), "gravity": ("gravity",), "damped base": ("damping",),
    "force for a while": ("no_single_mistake",),
} | {kind: causes for kind, (causes, *_) in CHANGES.items()}  # fmt: skip


def mistaken(kind: str, seed: int) -> tuple[Craft, Columns, np.ndarray]:
    """A drawn craft, a short log of it with one mistake of a kind, and the mistake's drawn sizes in
    the units in which an audit gives them.
    """
    draw = np.random.default_rng([58, list(MISTAKES).index(kind), seed])
    made = craft(int(draw.integers(10_000)), int(draw.integers(2, 6)))
    joint, sign = int(draw.integers(len(made.joints))), float(draw.choice([-1.0, 1.0]))
    name, own = made.joints[joint], float(reflected(made, 0)[joint])
    drawn = Drawn(made, name, draw)
    even, vector = drawn.even, drawn.vector
    size, options, after = [], {}, lambda log: log
    if kind == "zero shift":
        size = sign * even(0.003, 0.5)
        after = lambda log: added(log, name, size)  # noqa: E731
    elif kind in ("spring", "damping", "dry friction", "rotor"):
        field, share = {
            "spring": ("jnt_stiffness", 0.5), "damping": ("dof_damping", 0.3),
            "dry friction": ("dof_frictionloss", 0.05), "rotor": ("dof_armature", 0.3),
        }[kind]  # fmt: skip
        size = own * share * even(0.05, 200.0 if kind == "spring" else 1.0)
        first = 1 if kind == "spring" else 6
        if kind == "spring" and draw.random() < 0.4:
            options["size"] = 0.0  # one frequency: as if a rotor had a negative inertia
        options["change"] = _set(field, slice(first + joint, first + joint + 1), size)
    elif kind == "mass":
        size = 1.0 + sign * even(0.02, 0.4)
        options["heavier"] = int(draw.integers(1, len(made.joints) + 2)), size
    elif kind == "center":
        body, size = int(draw.integers(1, len(made.joints) + 2)), vector(even(0.01, 0.1))
        options["change"] = lambda model: model.body_ipos.__setitem__(
            body, model.body_ipos[body] + size
        )
    elif kind == "effort scale":
        size = 1.0 + sign * even(0.01, 0.3)
        after = lambda log: scaled(log, 1.0 / size, [f"{name}_effort"])  # noqa: E731
    elif kind == "frame":
        size = vector(even(1e-3, 2e-2))
        after = lambda log: in_turning_frame(world_rates(log), size)  # noqa: E731
    elif kind == "gyro bias":
        size = np.degrees(vector(even(3e-4, 3e-2)))
        after = lambda log: put(  # noqa: E731
            log, ANGULAR, rows(log, ANGULAR) + np.radians(size)
        )
    elif kind in ("gyro axes", "base axes"):
        size = np.degrees(vector(even(0.02, 2.0)))
        turn = Rotation.from_rotvec(size, degrees=True)
        after = (
            (lambda log: put(log, ANGULAR, turn.apply(rows(log, ANGULAR))))
            if kind == "gyro axes" else (lambda log: _tilted(world_rates(log), turn))
        )  # fmt: skip
    elif kind == "force":
        force = np.zeros(6)  # MuJoCo's: world axes, the torque's are the base's
        turns = bool(draw.random() < 0.5)
        force[3 * turns : 3 * turns + 3] = size = vector(even(0.01, 1.0))
        options["push"] = lambda t: force
    elif kind == "force for a while":
        force = np.append(vector(even(0.1, 1.0)), np.zeros(3))
        options["push"] = lambda t: force * (0.5 < t < 1.5)
    elif kind == "gravity":
        size = vector(even(1e-3, 10.0))
        options["change"] = lambda model: model.opt.gravity.__setitem__(slice(None), size)
    elif kind == "damped base":
        size = even(1.0, 20.0)
        options["change"] = _set("dof_damping", slice(6), size)
    elif kind in CHANGES:
        after = lambda log: CHANGES[kind][2](log, drawn)  # noqa: E731
    log = by_mujoco(
        made, int(draw.integers(10_000)), period=float(draw.choice([0.01, 0.02])), step=0.005,
        duration=3.0, spin=draw.uniform(0.05, 0.3), **options,
    )  # fmt: skip
    log = after(log)
    return made, log, np.atleast_1d(drawn.sizes or size)
