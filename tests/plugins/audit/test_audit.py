"""Audits of other simulators' logs: MuJoCo and Drake make true ones, every mistake made in these is
named.
"""

import collections
import dataclasses
import json
import os
import re
from pathlib import Path

import drawn_logs
import mujoco
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from drawn_logs import scaled, write

from ffsm_drake import load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.common.errors import ModelError, RecordError
from ffsm_drake.plugins.audit.dynamics import Dynamics
from ffsm_drake.plugins.audit.reading import read_log
from ffsm_drake.plugins.audit.verdict import audit
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.plant import make_plant, models_dir

MADE = drawn_logs.craft(12, 3)


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    path = tmp_path_factory.mktemp("craft") / "craft.urdf"
    path.write_text(MADE.urdf)
    return path


@pytest.fixture(scope="module")
def true_log():
    """By MuJoCo: its free joint has a linear velocity in world axes, an angular in body axes."""
    return drawn_logs.by_mujoco(MADE, 4, spin=0.2, duration=3.0)


def statement(found, name):
    return next(check.statement for check in found.checks if check.name == name)


def assert_physics(found, angular, linear):
    assert found.is_physics, str(found)
    assert statement(found, "angular velocity").startswith(f"in {angular} axes; agrees")
    assert statement(found, "base velocity").startswith(f"in {linear} axes; agrees")
    assert "conserved within" in statement(found, "momentum")
    assert "follows the work" in statement(found, "energy")


@pytest.mark.parametrize(("angular", "linear"), [("body", "world"), ("world", "body")])
def test_a_true_log_is_physics_in_any_axes(angular, linear, true_log, urdf, tmp_path):
    log = true_log if angular == "body" else drawn_logs.world_rates(true_log)
    log = log if linear == "world" else drawn_logs.body_velocity(log)
    assert_physics(audit(write(tmp_path / "log.csv", log), urdf), angular, linear)


@pytest.mark.long
def test_models_of_mujoco_are_read_as_new_reads_them(true_log, tmp_path):
    """With its sites and armature, which Drake's own parser refuses or drops."""
    log, spec = write(tmp_path / "log.csv", true_log), mujoco.MjSpec.from_string(MADE.urdf)
    spec.compiler.fusestatic = False
    spec.body("base").add_freejoint()
    spec.body("link_2").add_site(name="tool")
    for armature in (0.0, 2.0):
        spec.joint("hinge_1").armature = armature
        (tmp_path / "craft.xml").write_text(spec.to_xml())
        assert audit(log, tmp_path / "craft.xml").is_physics == (armature == 0.0)
    (tmp_path / "craft.xacro").write_text('<robot xmlns:xacro="x"><xacro:no/></robot>')
    with pytest.raises(ModelError, match=r"craft\.xacro: is a xacro file; convert it: ffsm new"):
        audit(log, tmp_path / "craft.xacro")


def pinocchio_log(pin, path):
    """A motion integrated by Pinocchio's forward dynamics and its Lie group, RK4."""
    model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    model.gravity.setZero()
    data, step, rows = model.createData(), 0.005, []
    torque, scale = drawn_logs.efforts_of(3, 4, 0.3), drawn_logs.reflected(MADE, 4)
    # its joints without limits have a cosine and a sine each
    q = pin.integrate(
        model, pin.neutral(model), np.array([0.0] * 3 + [0.3, -1.0, 1.0, 0.4, 1, 0.6])
    )
    v = np.array([0.02, -0.01, 0.03, 0.05, -0.08, 0.06, 0.1, -0.2, 0.15])
    for k in range(301):
        effort, angles = torque(0.01 * k) * scale, np.arctan2(q[8::2], q[7::2])
        rows.append([0.01 * k, q[6], *q[3:6], *q[:3], *angles, *v[3:6], *v[:3], *v[6:], *effort])
        tau = np.concatenate([np.zeros(6), effort])
        for _ in range(2):
            a1 = pin.aba(model, data, q, v, tau)
            v2 = v + 0.5 * step * a1
            a2 = pin.aba(model, data, pin.integrate(model, q, 0.5 * step * v), v2, tau)
            v3 = v + 0.5 * step * a2
            a3 = pin.aba(model, data, pin.integrate(model, q, 0.5 * step * v2), v3, tau)
            v4 = v + step * a3
            a4 = pin.aba(model, data, pin.integrate(model, q, step * v3), v4, tau)
            q = pin.integrate(model, q, step / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4))
            v = v + step / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    time, *table = np.hsplit(np.array(rows), [1, 11, 20])
    return drawn_logs.columns_of(MADE, time[:, 0], *table)


def test_a_log_of_pinocchio_is_physics(urdf, tmp_path):
    """Both of its velocities are in body axes."""
    pin = pytest.importorskip("pinocchio", reason="needs Pinocchio (extra 'oracles')")
    found = audit(write(tmp_path / "log.csv", pinocchio_log(pin, urdf)), urdf)
    assert_physics(found, "body", "body")


ARM = Path(__file__).parent / "basilisk_arm.urdf"  # and .csv, which basilisk_arm.py wrote


@pytest.fixture(scope="module")
def basilisk_log():
    """A spacecraft with an arm of three joints, past half a turn, where MRPs are switched."""
    return {
        name: column.to_numpy() for name, column in pd.read_csv(ARM.with_suffix(".csv")).items()
    }


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
    assert_physics(audit(ARM.with_suffix(".csv"), ARM), "body", "world")


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


def test_csv_is_read_as_people_have_it(true_log, urdf, tmp_path):
    """Semicolons, blank cells of a topic that came more seldom, rates that nobody logged."""
    joints, rates, efforts = (MADE.names(end) for end in ("", "_rate", "_effort"))
    path, names = tmp_path / "log.csv", [name for name in true_log if name not in efforts]
    rows = [";".join(names)]
    for k in range(len(true_log["time"])):
        cells = [f"{true_log[name][k]:.15g}" for name in names]
        rows.append(";".join("" if k % 2 and name in joints + rates else cell
                             for name, cell in zip(names, cells, strict=True)))  # fmt: skip
    path.write_text("\n".join(rows))
    assert audit(path, urdf).verdict != "no"
    write(path, {name: true_log[name] for name in names if name not in rates})
    assert audit(path, urdf).verdict == "yes"


@pytest.mark.long
def test_beside_the_drift_of_a_coarse_integrator_nothing_is_said(urdf, tmp_path):
    """MuJoCo's default steps lose momentum; a shorter step loses less."""

    def checked(step, tolerance):
        log = drawn_logs.by_mujoco(MADE, 4, spin=0.3, step=step, integrator="EULER")
        return audit(write(tmp_path / "log.csv", log), urdf, tolerance=tolerance)

    found = checked(0.01, 1e-3)
    assert not found.is_physics
    assert found.causes == (), str(found)
    assert str(found).endswith("cannot tell: integrator")
    assert checked(0.01, 0.5).is_physics
    assert checked(0.0005, 5e-3).is_physics


@pytest.mark.smoke
def test_the_command(true_log, urdf, tmp_path):
    """Columns by other names; exit codes; errors of one line."""
    log = {("t_sim" if name == "time" else name): v for name, v in true_log.items()}
    path = write(tmp_path / "log.csv", log)
    words = ["audit", str(path), "--urdf", str(urdf)]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 2
    assert "has no column time (or t); name it with --column time=COLUMN" in result.output
    result = CliRunner().invoke(main, [*words, "--column", "time=t_sim", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["is_physics"] is True
    bad = write(tmp_path / "bad.csv", scaled(log, 1.01, drawn_logs.QUATERNION))
    words[1] = str(bad)
    result = CliRunner().invoke(main, [*words, "--column", "time=t_sim"])
    assert result.exit_code == 3
    assert result.output.endswith("Is this log physics? no: quaternion_norm\n")


def test_logs_that_cannot_be_read(true_log, urdf, tmp_path):
    path = tmp_path / "log.csv"
    for text, said in {
        "": "it is empty",
        "x,y\n1,2\n": "has no column time",
        "time,time\n1,2\n": "two columns are called time",
        "time,t\n1\n": "has no column base_quaternion_w",
    }.items():
        path.write_text(text)
        with pytest.raises(RecordError, match=said):
            audit(path, urdf)
    with pytest.raises(RecordError, match="has 3 samples; at least 10"):
        audit(write(path, {name: column[:3] for name, column in true_log.items()}), urdf)
    with pytest.raises(RecordError, match="has 1 sample; at least 10 are needed, each later"):
        audit(write(path, scaled(true_log, 0.0, ["time"])), urdf)
    with pytest.raises(RecordError, match="hinge_0 has no number"):
        audit(write(path, scaled(true_log, np.nan, ["hinge_0"])), urdf)
    with pytest.raises(RecordError, match=r"hinge_0 is .*e\+299 in sample 0, not a finite number"):
        audit(write(path, scaled(true_log, 1e300, ["hinge_0"])), urdf)
    with pytest.raises(RecordError, match="the quaternion is zero in sample 0"):
        audit(write(path, scaled(true_log, 0.0, drawn_logs.QUATERNION)), urdf)
    (tmp_path / "log.nc").write_bytes(b"no netCDF")
    with pytest.raises(RecordError, match="cannot be read"):
        audit(tmp_path / "log.nc", urdf)


FIRST = int(os.environ.get("AUDIT_SEED", "0"))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(FIRST, FIRST + 5))
def test_drawn_logs(seed, tmp_path):
    """No true one is accused, none of the others passes; -s prints them.

    Draws 0 to 7 were seen during the design; AUDIT_SEED begins at another seed.
    """
    for name, log in drawn_logs.true_logs(tmp_path, seed).items():
        found = audit(log, log.with_suffix(".urdf"))
        assert found.verdict != "no", f"{name}: {found}"
        print(f"| {name} | {found.verdict}: {', '.join(found.doubts)} |")
    kinds = [kind for kind in drawn_logs.MISTAKES if kind != "none"]
    results = {kind: outcome(kind, 100 + seed, tmp_path) for kind in kinds}
    unlike = {
        kind: (how, found.verdict) for kind, (how, found) in results.items() if how != "right"
    }
    print(f"of {len(kinds)} mistakes not named: {unlike}")
    assert not [str(found) for how, found in results.values() if found.verdict == "yes"]
    assert len(unlike) <= 2
    assert not [kind for kind, (how, _) in unlike.items() if how == "wrong"]


def outcome(kind, seed, folder):
    """Whether an audit names a drawn mistake within 5 % of its size, or 15 % if it states such an
    error: right, undecided or wrong; and the audit.
    """
    made, log, sizes = drawn_logs.mistaken(kind, seed)
    (folder / "craft.urdf").write_text(made.urdf)
    found = audit(write(folder / "log.csv", log), folder / "craft.urdf")
    causes, words, _ = drawn_logs.CHANGES.get(kind, (drawn_logs.MISTAKES[kind], "", None))
    named = {cause for causes in found.causes for cause in causes.split(" or ")}
    named -= {"no_single_mistake", "cannot_say_which"} - {*causes}
    if not named:
        is_right = found.verdict == "yes" and kind == "none"
        return ("right" if is_right else "undecided"), found
    said = " ".join(check.statement for check in found.checks if check.cause)
    numbers = np.array([float(x) for x in re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", said)])
    off = [np.abs(np.abs(numbers) - abs(x)).min() for x in sizes]
    errors = [float(x) for x in re.findall(r"± (\S+)", said)]
    largest = np.abs(sizes).max(initial=0.0)
    allowed = max(0.05 * largest, min(2.0 * max(errors, default=0.0), 0.15 * largest))
    is_right = named & {*causes} and words in said and (not off or max(off) < allowed)
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


QUICK = {"zero shift", "spring", "center", "rate scale", "gyro scale", "time scale", "all efforts"}
QUICK |= {"effort sign"}


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=() if kind in QUICK else pytest.mark.long)
        for kind in drawn_logs.MISTAKES
    ],
)
def test_a_drawn_mistake_is_named_or_nothing_is(kind, tmp_path):
    """AUDIT_DRAWS logs of each kind (``drawn_logs.mistaken``), from the seed AUDIT_SEED on; -s
    prints the table.
    """
    draws = int(os.environ.get("AUDIT_DRAWS", "1"))
    found = [outcome(kind, seed, tmp_path) for seed in range(FIRST, FIRST + draws)]
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
