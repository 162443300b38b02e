"""Audits of other simulators' logs: MuJoCo and Drake make true ones, every mistake made in these is
named.
"""

import collections
import csv
import dataclasses
import json
import os
import re
from pathlib import Path

import drawn_logs
import mujoco
import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.common.errors import ModelError, RecordError
from ffsm_drake.plugins.audit.dynamics import Dynamics
from ffsm_drake.plugins.audit.reading import read_log
from ffsm_drake.plugins.audit.verdict import audit
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.plant import make_plant, models_dir

URDF = models_dir() / "urdf" / "servicer.urdf"
JOINTS = [f"joint_{i}" for i in range(1, 6)]
NAMES = [
    "time", *(f"base_position_{x}" for x in "xyz"), *(f"base_quaternion_{x}" for x in "wxyz"),
    *JOINTS, *(f"base_velocity_{x}" for x in "xyz"),
    *(f"base_angular_velocity_{x}" for x in "xyz"), *(f"{name}_rate" for name in JOINTS),
    *(f"{name}_effort" for name in JOINTS),
]  # fmt: skip
QUATERNION = [f"base_quaternion_{x}" for x in "wxyz"]
PERIOD = 0.01


def craft():
    """The shipped servicer in MuJoCo, free."""
    spec = mujoco.MjSpec.from_file(str(URDF))
    spec.compiler.fusestatic = False
    spec.body("base").add_freejoint()
    return spec


def mujoco_log(
    *,
    gravity=(0.0, 0.0, 0.0),
    heavy=1.0,
    damping=0.0,
    step=0.002,
    push=0.0,
    integrator=mujoco.mjtIntegrator.mjINT_RK4,
):
    """The shipped servicer, its arm swung by torques for 5 s: columns by name."""
    spec = craft()
    spec.body("link_3").mass *= heavy
    spec.body("link_3").inertia *= heavy
    spec.option.gravity, spec.option.timestep = gravity, step
    spec.option.integrator = integrator
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.dof_damping[:6] = damping
    data = mujoco.MjData(model)
    data.qpos[3:7] = [0.7, 0.1, -0.5, 0.5]
    data.qpos[7:] = [0.2, 0.4, 1.0, 0.6, -0.7]
    data.qvel[:] = [0.02, -0.01, 0.03, 0.05, -0.08, 0.06, 0.1, -0.2, 0.15, 0.1, -0.1]
    rows = []
    for k in range(501):
        t = k * PERIOD
        data.qfrc_applied[6:] = np.array([2.0, 4.0, 2.0, 0.3, 0.05]) * np.cos(
            np.array([1.0, 1.5, 2.0, 2.5, 3.0]) * t
        )
        data.qfrc_applied[0] = push if t > 2.0 else 0.0
        rows.append([t, *data.qpos, *data.qvel, *data.qfrc_applied[6:]])
        for _ in range(round(PERIOD / step)):
            mujoco.mj_step(model, data)
    return dict(zip(NAMES, np.array(rows).T, strict=True))


@pytest.fixture(scope="module")
def true_log():
    return mujoco_log()


def write(path, columns):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(np.array(list(columns.values())).T.tolist())
    return path


def statement(found, name):
    return next(check.statement for check in found.checks if check.name == name)


def test_a_log_of_mujoco_is_physics(true_log, tmp_path):
    """Its free joint has the linear velocity in world axes, the angular one in body axes."""
    found = audit(write(tmp_path / "log.csv", true_log), URDF)
    assert found.is_physics, str(found)
    assert statement(found, "angular velocity").startswith("in body axes")
    assert statement(found, "base velocity").startswith("in world axes")
    assert "conserved within" in statement(found, "momentum")
    assert "follows the work" in statement(found, "energy")


@pytest.mark.long
def test_models_of_mujoco_are_read_as_new_reads_them(true_log, tmp_path):
    """With its sites and armature, which Drake's own parser refuses or drops."""
    log, spec = write(tmp_path / "log.csv", true_log), craft()
    spec.body("link_5").add_site(name="tool")
    for armature in (0.0, 2.0):
        spec.joint("joint_2").armature = armature
        (tmp_path / "craft.xml").write_text(spec.to_xml())
        assert audit(log, tmp_path / "craft.xml").is_physics == (armature == 0.0)
    (tmp_path / "craft.xacro").write_text('<robot xmlns:xacro="x"><xacro:no/></robot>')
    with pytest.raises(ModelError, match=r"craft\.xacro: is a xacro file; convert it: ffsm new"):
        audit(log, tmp_path / "craft.xacro")


def pinocchio_log(pin):
    """The same motion, integrated by Pinocchio's forward dynamics and its Lie group, RK4."""
    model = pin.buildModelFromUrdf(str(URDF), pin.JointModelFreeFlyer())
    model.gravity.setZero()
    data, step = model.createData(), 0.005
    q = pin.neutral(model)
    q[3:7] = np.array([0.1, -0.5, 0.5, 0.7]) / np.linalg.norm([0.1, -0.5, 0.5, 0.7])
    # its joints without limits have a cosine and a sine each
    q = pin.integrate(model, q, np.array([0.0] * 6 + [0.2, 0.4, 1.0, 0.6, -0.7]))
    v = np.array([0.02, -0.01, 0.03, 0.05, -0.08, 0.06, 0.1, -0.2, 0.15, 0.1, -0.1])
    rows = []
    for k in range(501):
        angles = np.arctan2(q[8::2], q[7::2])
        rate, size = np.array([1.0, 1.5, 2.0, 2.5, 3.0]), np.array([2.0, 4.0, 2.0, 0.3, 0.05])
        tau = np.concatenate([np.zeros(6), size * np.cos(rate * k * PERIOD)])
        rows.append([k * PERIOD, *q[:3], q[6], *q[3:6], *angles, *v, *tau[6:]])
        for _ in range(round(PERIOD / step)):
            a1 = pin.aba(model, data, q, v, tau)
            v2 = v + 0.5 * step * a1
            a2 = pin.aba(model, data, pin.integrate(model, q, 0.5 * step * v), v2, tau)
            v3 = v + 0.5 * step * a2
            a3 = pin.aba(model, data, pin.integrate(model, q, 0.5 * step * v2), v3, tau)
            v4 = v + step * a3
            a4 = pin.aba(model, data, pin.integrate(model, q, step * v3), v4, tau)
            q = pin.integrate(model, q, step / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4))
            v = v + step / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return dict(zip(NAMES, np.array(rows).T, strict=True))


def test_a_log_of_pinocchio_is_physics(tmp_path):
    """Both of its velocities are in body axes."""
    pin = pytest.importorskip("pinocchio", reason="needs Pinocchio (extra 'oracles')")
    found = audit(write(tmp_path / "log.csv", pinocchio_log(pin)), URDF)
    assert found.is_physics, str(found)
    assert statement(found, "angular velocity").startswith("in body axes")
    assert statement(found, "base velocity").startswith("in body axes")
    assert "conserved within" in statement(found, "momentum")
    assert "follows the work" in statement(found, "energy")


ARM = Path(__file__).parent / "basilisk_arm.urdf"  # and .csv, which basilisk_arm.py wrote


@pytest.fixture(scope="module")
def basilisk_log():
    """A spacecraft with an arm of three joints, past half a turn, where MRPs are switched."""
    with ARM.with_suffix(".csv").open(newline="") as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


def triple(log, name):
    return np.array([log[f"{name}_{i}"] for i in range(3)])


def with_triple(log, name, values):
    return log | {f"{name}_{i}": row for i, row in enumerate(values)}


def dcm(log):
    """R_NB (n, 3, 3), from MRPs by the Cayley transform, taken twice."""
    skew = np.cross(np.eye(3), triple(log, "sigma_BN").T[:, None])
    half = np.linalg.solve(np.eye(3) - skew, np.eye(3) + skew)
    return half @ half


def turned(log, name, rotations):
    return with_triple(log, name, np.einsum("kij,jk->ik", rotations, triple(log, name)))


def test_a_log_of_basilisk_is_physics(basilisk_log):
    """By its own names: MRPs, which switch once, rates in body axes; joints counted from 0."""
    assert np.abs(np.diff(triple(basilisk_log, "sigma_BN"))).max() > 1.0
    found = audit(ARM.with_suffix(".csv"), ARM)
    assert found.is_physics, str(found)
    assert statement(found, "angular velocity").startswith("in body axes; agrees")
    assert statement(found, "base velocity").startswith("in world axes; agrees")
    assert "conserved within" in statement(found, "momentum")
    assert "follows the work" in statement(found, "energy")


@pytest.mark.parametrize("form", ["{}_{}", "{}[{}]", "{}.{}"])
def test_columns_are_numbered_in_many_ways(form, basilisk_log, tmp_path):
    """Vectors by x, y, z, or from 0; joints by name, or from 0 or 1."""
    log = {"time": basilisk_log["time"]}
    for name in ("r_BN_N", "v_BN_N", "sigma_BN", "omega_BN_B"):
        log |= zip([form.format(name, x) for x in "xyz"], triple(basilisk_log, name), strict=True)
    for name in ("theta", "thetaDot"):
        log |= zip([f"{name}{i}" for i in (1, 2, 3)], triple(basilisk_log, name), strict=True)
    if form != "{}_{}":
        log = {name.translate({120: "0", 121: "1", 122: "2"}): v for name, v in log.items()}
    found = audit(write(tmp_path / "log.csv", log), ARM)
    assert found.is_physics, str(found)
    assert statement(found, "energy").endswith("to have it checked")


def heavier(text):
    return text.replace('<mass value="20"/>', '<mass value="30"/>')


# mistake -> how it is made in Basilisk's log, what it makes of the URDF, cause, words
BASILISK = {
    "rates in world axes": (
        lambda log: turned(log, "omega_BN_B", dcm(log)), str,
        "axes", "in world axes, but the log states body axes",
    ),
    "rates taken as in world axes": (
        lambda log: turned(log, "omega_BN_B", dcm(log).transpose(0, 2, 1)), str,
        "axes", "body axes were taken for world axes and turned to body axes once more",
    ),
    "world rates taken as in body axes": (
        lambda log: turned(log, "omega_BN_B", dcm(log) @ dcm(log)), str,
        "axes", "world axes were taken for body axes and turned to world axes once more",
    ),
    "velocity in body axes": (
        lambda log: turned(log, "v_BN_N", dcm(log).transpose(0, 2, 1)), str,
        "axes", "in body axes, but the log states world axes",
    ),
    "sigma_NB": (
        lambda log: with_triple(log, "sigma_BN", -triple(log, "sigma_BN")), str,
        "quaternion_inverse", "sigma_NB, not sigma_BN",
    ),
    "another mass in the URDF": (
        dict, heavier, "mass", "lower has 0.667 times the mass of the URDF",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", BASILISK)
def test_a_mistake_with_basilisk_is_named(mistake, basilisk_log, tmp_path):
    make, change, cause, words = BASILISK[mistake]
    model = tmp_path / "arm.urdf"
    model.write_text(change(ARM.read_text()))
    found = audit(write(tmp_path / "log.csv", make(basilisk_log)), model)
    assert set(found.causes) == {cause}, str(found)
    assert words in str(found)


@pytest.mark.slow
@pytest.mark.parametrize("point", ["base's", "spacecraft's"])
def test_another_point_of_the_spacecraft_is_named(point, basilisk_log, tmp_path):
    """Basilisk's point B is the base's origin; Bc and C are centres of mass."""
    dynamics = Dynamics(make_plant(Model(directives=str(ARM), end_effector="basilisk_arm::hand")))
    log = basilisk_log
    arm, swing = dynamics.points(
        dataclasses.replace(
            read_log(ARM.with_suffix(".csv"), dynamics.names),
            angular=np.einsum("kij,jk->ki", dcm(log), triple(log, "omega_BN_B")),
        )
    )[f"the {point} centre of mass"]
    log = with_triple(log, "v_BN_N", triple(log, "v_BN_N") + swing.T)
    found = audit(write(tmp_path / "log.csv", log), ARM)
    assert found.causes == ("axes",), str(found)
    assert f"of the {point} centre of mass, but" in statement(found, "base velocity")
    log = with_triple(log, "r_BN_N", triple(log, "r_BN_N") + arm.T)
    found = audit(write(tmp_path / "log.csv", log), ARM)
    assert found.causes == ("point",), str(found)
    assert f"belong to the {point} centre of mass" in statement(found, "momentum")


@pytest.mark.slow
def test_a_record_of_this_package_is_physics(tmp_path):
    """Also with forces on its base, held over each period."""
    record = simulate(load_scenario("postcapture", ["duration=1.5", "disturbance.harmonics={}"]))
    record.save(tmp_path / "run")
    found = audit(tmp_path / "run" / "record.nc", models_dir() / "postcapture.dmd.yaml")
    assert found.is_physics, str(found)
    assert statement(found, "angular velocity").startswith("in world axes")
    assert "follows the work" in statement(found, "energy")


def rotated(log, vector, back=False):
    """Three columns turned from body to world axes, or back."""
    w, u = log["base_quaternion_w"], np.array([log[f"base_quaternion_{x}"] for x in "xyz"])
    values = np.array([log[f"{vector}_{x}"] for x in "xyz"])
    u = -u if back else u
    twice = 2.0 * np.cross(u, values, axis=0)
    turned = values + w * twice + np.cross(u, twice, axis=0)
    return {f"{vector}_{x}": row for x, row in zip("xyz", turned, strict=True)}


def test_frames_are_told_apart(true_log, tmp_path):
    other = true_log | rotated(true_log, "base_velocity", back=True)
    other |= rotated(true_log, "base_angular_velocity")
    found = audit(write(tmp_path / "log.csv", other), URDF)
    assert found.is_physics, str(found)
    assert statement(found, "angular velocity").startswith("in world axes")
    assert statement(found, "base velocity").startswith("in body axes")


def exchanged(log, *pairs):
    changes = {}
    for first, second in pairs:
        changes |= {first: log[second], second: log[first]}
    return log | changes


def scaled(log, factor, *names):
    return log | {name: log[name] * factor for name in names}


def taken(log, rows, *, renumbered=False):
    some = {name: values[rows] for name, values in log.items()}
    return some | ({"time": PERIOD * np.arange(len(rows))} if renumbered else {})


DEGREE = 180.0 / np.pi
RATES = [f"{name}_rate" for name in JOINTS]
KEPT = np.delete(np.arange(501), [50, 51, 200, 333, 334, 335])
STALE = np.where(np.isin(np.arange(501), [70, 150, 260]), np.arange(501) - 1, np.arange(501))
# mistake -> how it is made in a true log, the cause that names it, words of the statement
BROKEN = {
    "exchanged joints": (
        lambda log: exchanged(log, ("joint_2", "joint_3"), ("joint_2_rate", "joint_3_rate")),
        "joint_order", "joint_2 and joint_3 are exchanged",
    ),
    "exchanged rates": (
        lambda log: exchanged(log, ("joint_2_rate", "joint_3_rate")),
        "joint_order", "not its own: that of joint_3 is",
    ),
    "joint the other way": (
        lambda log: scaled(log, -1.0, "joint_2", "joint_2_rate"),
        "joint_sign", "joint_2 has the opposite sign",
    ),
    "joints in degrees": (
        lambda log: scaled(log, DEGREE, *JOINTS, *RATES), "degrees", "every joint is in degrees",
    ),
    "rates in degrees": (
        lambda log: scaled(log, DEGREE, *RATES), "degrees", "degrees per second",
    ),
    "scalar last": (
        lambda log: log | dict(zip(QUATERNION, [log[f"base_quaternion_{x}"] for x in "xyzw"],
                                   strict=True)),
        "quaternion_order", "scalar of the quaternion is last",
    ),
    "quaternion inverse": (
        lambda log: scaled(log, -1.0, *QUATERNION[1:]), "quaternion_inverse", "R_BW",
    ),
    "quaternion not normalized": (
        lambda log: scaled(log, np.linspace(1.0, 1.02, 501), *QUATERNION),
        "quaternion_norm", "1 to 1.02, not 1",
    ),
    "wrong frame": (
        lambda log: log | rotated(log | rotated(log, "base_velocity"), "base_velocity"),
        "no_single_mistake", "which no one mistake explains",
    ),
    "dropped samples": (lambda log: taken(log, KEPT), "dropped_samples", "about 6 samples"),
    "dropped samples, renumbered": (
        lambda log: taken(log, KEPT, renumbered=True), "dropped_samples", "about 6 samples",
    ),
    "repeated samples": (
        lambda log: taken(log, STALE) | {"time": log["time"]}, "repeated_samples", "3 samples",
    ),
    "order of time": (
        lambda log: taken(log, [*range(100), *range(90, 501)]), "time_order", "10 samples",
    ),
    "milliseconds": (lambda log: scaled(log, 1e3, "time"), "time_unit", "milliseconds"),
    "another link mass": (
        lambda _: mujoco_log(heavy=1.5), "mass", "link_3 has 1.5 times the mass",
    ),
    "gravity": (
        lambda _: mujoco_log(gravity=(0.0, 0.0, -9.81)), "gravity",
        "-9.81] ±",
    ),
    "damping": (lambda _: mujoco_log(damping=5.0), "damping", "N s/m and 5 N m s"),
    "unknown force": (lambda _: mujoco_log(push=3.0), "no_single_mistake", "not logged"),
    "a joint's zero": (
        lambda log: offset(log, 0.1, "joint_2"), "zero_shift",
        "joint_2's position has a constant offset of 0.1 ±",
    ),
    "heavier units": (
        lambda log: scaled(log, 2.0, *(f"{name}_effort" for name in JOINTS)),
        "mass_or_effort_scale", "2 times the URDF's",
    ),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("mistake", BROKEN)
def test_a_mistake_is_named(mistake, true_log, tmp_path):
    make, cause, words = BROKEN[mistake]
    found = audit(write(tmp_path / "log.csv", make(true_log)), URDF)
    assert set(found.causes) == {cause}, str(found)
    assert words in str(found)


EFFORTS = [f"{name}_effort" for name in JOINTS]
OMEGA = [f"base_angular_velocity_{x}" for x in "xyz"]


def offset(log, value, *names):
    return log | {name: log[name] + value for name in names}


@pytest.mark.parametrize("seed", range(6))
def test_small_mistakes_are_findings(seed, true_log, tmp_path):
    """Below a tenth, of a drawn size: a fit that explains a mistake does not forgive it."""
    random = np.random.default_rng(seed)
    factor = 1.0 + random.choice([-1.0, 1.0]) * random.uniform(0.01, 0.1)
    log, expected = [
        (scaled(true_log, factor, random.choice(RATES)), "scale"),
        (scaled(true_log, factor, *OMEGA), "scale"),
        (scaled(true_log, factor, "time"), "time"),
        (scaled(true_log, factor, *EFFORTS), "mass_or_effort_scale"),
        (scaled(true_log, -1.0, random.choice(EFFORTS)), ""),
        (offset(true_log, random.uniform(1e-4, 1e-3), random.choice(OMEGA)), "rate_offset"),
    ][seed]
    found = audit(write(tmp_path / "log.csv", log), URDF)
    assert found.verdict == "no", str(found)
    assert expected in " ".join(found.causes), str(found)


def test_csv_is_read_as_people_have_it(true_log, tmp_path):
    """Semicolons, blank cells of a topic that came more seldom, rates that nobody logged."""
    path, names = tmp_path / "log.csv", [name for name in true_log if name not in EFFORTS]
    rows = [";".join(names)]
    for k in range(len(true_log["time"])):
        cells = [f"{true_log[name][k]:.15g}" for name in names]
        rows.append(";".join("" if k % 2 and name in JOINTS + RATES else cell
                             for name, cell in zip(names, cells, strict=True)))  # fmt: skip
    path.write_text("\n".join(rows))
    assert audit(path, URDF).verdict != "no"
    write(path, {name: true_log[name] for name in names if name not in RATES})
    assert audit(path, URDF).verdict == "yes"


@pytest.mark.long
def test_beside_the_drift_of_a_coarse_integrator_nothing_is_said(tmp_path):
    """MuJoCo's default steps lose momentum; a shorter step loses less."""
    euler = mujoco.mjtIntegrator.mjINT_EULER
    path = tmp_path / "log.csv"
    found = audit(write(path, mujoco_log(integrator=euler, step=0.01)), URDF)
    assert not found.is_physics
    assert found.causes == (), str(found)
    assert str(found).endswith("cannot tell: integrator")
    assert audit(path, URDF, tolerance=0.5).is_physics
    write(path, mujoco_log(integrator=euler, step=0.0005))
    assert audit(path, URDF, tolerance=5e-3).is_physics


@pytest.mark.smoke
def test_the_command(true_log, tmp_path):
    """Columns by other names; exit codes; errors of one line."""
    log = {("t_sim" if name == "time" else name): v for name, v in true_log.items()}
    path = write(tmp_path / "log.csv", log)
    words = ["audit", str(path), "--urdf", str(URDF)]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 2
    assert "has no column time (or t); name it with --column time=COLUMN" in result.output
    result = CliRunner().invoke(main, [*words, "--column", "time=t_sim", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["is_physics"] is True
    bad = write(tmp_path / "bad.csv", scaled(log, 1.01, *QUATERNION))
    words[1] = str(bad)
    result = CliRunner().invoke(main, [*words, "--column", "time=t_sim"])
    assert result.exit_code == 3
    assert result.output.endswith("Is this log physics? no: quaternion_norm\n")


def test_logs_that_cannot_be_read(true_log, tmp_path):
    path = tmp_path / "log.csv"
    for text, said in {
        "": "it is empty",
        "x,y\n1,2\n": "has no column time",
        "time,time\n1,2\n": "two columns are called time",
        "time,t\n1\n": "has no column base_quaternion_w",
    }.items():
        path.write_text(text)
        with pytest.raises(RecordError, match=said):
            audit(path, URDF)
    with pytest.raises(RecordError, match="has 3 samples; at least 10"):
        audit(write(path, taken(true_log, [0, 1, 2])), URDF)
    with pytest.raises(RecordError, match="has 1 sample; at least 10 are needed, each later"):
        audit(write(path, scaled(true_log, 0.0, "time")), URDF)
    with pytest.raises(RecordError, match="joint_1 has no number"):
        audit(write(path, scaled(true_log, np.nan, "joint_1")), URDF)
    with pytest.raises(RecordError, match=r"joint_1 is 2e\+299 in sample 0, not a finite number"):
        audit(write(path, scaled(true_log, 1e300, "joint_1")), URDF)
    with pytest.raises(RecordError, match="the quaternion is zero in sample 0"):
        audit(write(path, scaled(true_log, 0.0, *QUATERNION)), URDF)
    (tmp_path / "log.nc").write_bytes(b"no netCDF")
    with pytest.raises(RecordError, match="cannot be read"):
        audit(tmp_path / "log.nc", URDF)


def told(case):
    """The audit of a drawn log, and whether it names what is wrong there."""
    found = audit(case.log, case.urdf)
    assert found.verdict != ("yes" if case.causes else "no"), f"{case.name}: {found}"
    return found, not case.causes or bool(set(case.causes) & set(found.causes))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.93, 0.995, 1.005, 1.07])
def test_a_small_scale_is_a_finding(factor, tmp_path):
    """Of a rate, of the time and of an effort; sixty logs are tried below."""
    craft = drawn_logs.craft(12, 3)
    log = drawn_logs.by_mujoco(craft, 4, spin=0.2, duration=3.0)
    (tmp_path / "craft.urdf").write_text(craft.urdf)
    for names, cause in {
        (): None,
        ("hinge_1_rate",): "rate_scale",
        tuple(drawn_logs.ANGULAR): "rate_scale",
        ("time",): "time_scale",
        ("hinge_0_effort",): "effort_scale",
    }.items():
        path = drawn_logs.write(tmp_path / "log.csv", drawn_logs.scaled(log, factor, list(names)))
        found = audit(path, tmp_path / "craft.urdf")
        assert found.causes == ((cause,) if cause else ()), str(found)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
def test_sixty_drawn_logs(seed, tmp_path):
    """No true one is accused, none of the others passes, 39 of 40 are named; -s prints them."""
    cases = [*drawn_logs.true_logs(tmp_path, seed), *drawn_logs.wrong_logs(tmp_path, seed)]
    assert sum(bool(case.causes) for case in cases) == 40
    assert len(cases) == 60
    named = 0
    for case in cases:
        found, is_named = told(case)
        named += is_named and bool(case.causes)
        why = ", ".join(found.causes or found.doubts)
        print(f"| {case.name} | {found.verdict}{': ' if why else ''}{why} |")
    assert named >= 39


def outcome(kind, seed, folder):
    """Whether an audit names a drawn mistake within 5 % of its size, or 15 % if it states such an
    error: right, undecided or wrong; and the audit.
    """
    made, log, sizes = drawn_logs.mistaken(kind, seed)
    (folder / "craft.urdf").write_text(made.urdf)
    found = audit(drawn_logs.write(folder / "log.csv", log), folder / "craft.urdf")
    named = {cause for causes in found.causes for cause in causes.split(" or ")}
    named -= {"no_single_mistake", "cannot_say_which"}
    if not named:
        is_right = found.verdict == "yes" and kind == "none"
        return ("right" if is_right else "undecided"), found
    said = " ".join(check.statement for check in found.checks if check.cause)
    numbers = np.array([float(x) for x in re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", said)])
    off = [np.abs(np.abs(numbers) - abs(x)).min() for x in sizes]
    errors = [float(x) for x in re.findall(r"± (\S+)", said)]
    largest = np.abs(sizes).max()
    allowed = max(0.05 * largest, min(2.0 * max(errors, default=0.0), 0.15 * largest))
    is_right = named & set(drawn_logs.MISTAKES[kind]) and max(off) < allowed
    return ("right" if is_right else "wrong"), found


# Logs in which many explanations are nearly as good: mistakes of a joint whose motion is of one
# frequency or in one direction, or whose friction MuJoCo turns around earlier than its rate.
HARD = {
    "spring": (14, 26, 30, 31, 33, 56, 138),
    "dry friction": (15, 32, 40, 113, 135, 142),
    "zero shift": (23, 72),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", HARD)
def test_a_mistake_that_others_nearly_explain_is_named(kind, tmp_path):
    for seed in HARD[kind]:
        how, found = outcome(kind, seed, tmp_path)
        assert how == "right", (seed, str(found))


QUICK = {"zero shift", "spring", "center"}


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=() if kind in QUICK else pytest.mark.slow)
        for kind in drawn_logs.MISTAKES
    ],
)
def test_a_drawn_mistake_is_named_or_nothing_is(kind, tmp_path):
    """AUDIT_DRAWS logs of each kind (``drawn_logs.mistaken``), from the seed AUDIT_SEED on; -s
    prints the table.
    """
    draws, first = int(os.environ.get("AUDIT_DRAWS", "1")), int(os.environ.get("AUDIT_SEED", "0"))
    found = [outcome(kind, seed, tmp_path) for seed in range(first, first + draws)]
    table = collections.Counter(how for how, _ in found)
    print(f"| {kind} | {' | '.join(str(table[x]) for x in ('right', 'undecided', 'wrong'))} |")
    assert not table["wrong"], "\n".join(str(each) for how, each in found if how == "wrong")
    assert table["right"] >= 0.7 * draws - 1, table  # small ones are within the tolerance


@pytest.mark.slow
def test_a_disturbance_of_a_record_is_accounted_for(tmp_path):
    """It acts beside the actuators, on base and joints."""
    simulate(load_scenario("postcapture", ["duration=1.5"])).save(tmp_path / "run")
    found = audit(tmp_path / "run" / "record.nc", models_dir() / "postcapture.dmd.yaml")
    assert found.verdict == "yes", str(found)


CHAINS = {
    "cannot tell": ["controller=tdc", "duration=1.5"],
    "cannot tell, a force that grows": ["controller=asmc", "chain.law=plain", "duration=1.5",
                                        "sensing.position_bias={left_2: 1e-4}"],
    "yes": ["controller=asmc", "chain.law=plain", "sensing.position_bias={left_2: 1e-4}",
            "duration=5"],
    "yes, a spring": ["contacts.right.kind=compliant", "chain.law=plain", "duration=1.5",
                      "simulator_config.max_step_size=1e-3"],
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("case", CHAINS)
def test_a_record_of_a_closed_chain_is_accounted_for(case, tmp_path):
    """The force of its loops jumps with the efforts, or is smooth; no wrong effort passes."""
    run = simulate(load_scenario("two_arms", CHAINS[case]), check_stability=False)
    model = tmp_path / "two.dmd.yaml"
    urdf = "package://ffsm_drake/urdf/two_arms"
    model.write_text(f"""
directives:
- add_model: {{name: servicer, file: {urdf}.urdf}}
- add_model: {{name: debris, file: {urdf}_target.urdf}}
- add_weld: {{parent: servicer::left_hand, child: debris::left_grasp}}
""")
    run.save(tmp_path / "run")
    found = audit(tmp_path / "run" / "record.nc", model)
    assert found.verdict == case.partition(",")[0], str(found)
    run.dataset["applied_force"].loc[{"coordinate": "right_2"}] *= 1.2
    run.save(tmp_path / "wrong")
    assert audit(tmp_path / "wrong" / "record.nc", model).verdict != "yes"
