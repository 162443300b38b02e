"""Audits of logs in MCAP: exported runs, and messages as other users of ROS 2 record them."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario, simulate
from ffsm_drake.common.errors import FfsmError, RecordError
from ffsm_drake.plugins.audit import mcap
from ffsm_drake.plugins.audit.reading import read_log
from ffsm_drake.plugins.audit.verdict import audit
from ffsm_drake.spacecraft.plant import models_dir

pytest.importorskip("foxglove", reason="needs foxglove-sdk")
pytest.importorskip("mcap_protobuf", reason="needs mcap-protobuf-support")
writer = pytest.importorskip("mcap_ros2.writer", reason="needs mcap-ros2-support")

from mcap.reader import make_reader  # noqa: E402
from mcap.writer import Writer  # noqa: E402

foxglove, ros2 = (
    pytest.importorskip(f"ffsm_drake.plugins.exports.{name}") for name in ("foxglove", "ros2")
)

URDF = models_dir() / "postcapture.dmd.yaml"
ARM = Path(__file__).parent / "basilisk_arm.urdf"
JOINTS = ["shoulder", "elbow", "wrist"]


WRITERS = {"run.mcap": foxglove.write, "ros2.mcap": ros2.write}


@pytest.fixture(scope="module")
def record():
    scenario = load_scenario("postcapture", ["duration=0.8", "disturbance.harmonics={}"])
    return simulate(scenario, check_stability=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, record):
    """What ``ffsm export`` writes of a run."""
    folder = tmp_path_factory.mktemp("run")
    for name, write in WRITERS.items():
        write(record, folder / name)
    return folder


@pytest.fixture(scope="module")
def definitions(folder):
    """Those of ROS 2's messages, by name."""
    with (folder / "ros2.mcap").open("rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()
        return {schema.name: schema.data.decode() for schema in schemas}


def statement(found, name):
    return next(check.statement for check in found.checks if check.name == name)


@pytest.mark.smoke
@pytest.mark.parametrize("name", WRITERS)
def test_an_exported_run_is_physics(name, folder):
    found = audit(folder / name, URDF)
    assert found.is_physics, str(found)
    axes = "in body axes" if name == "ros2.mcap" else "in world axes"
    assert statement(found, "angular velocity").startswith(axes)
    assert "conserved within" in statement(found, "momentum")
    assert "follows the work" in statement(found, "energy")


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_exchanged_joints_are_named(name, record, tmp_path):
    data = record.dataset.copy(deep=True)
    for series in (data["position"], data["velocity"]):
        places = [list(series[series.dims[1]].values).index(f"joint_{i}") for i in (2, 3)]
        series.values[:, places] = series.values[:, places[::-1]]
    WRITERS[name](dataclasses.replace(record, dataset=data), tmp_path / name)
    found = audit(tmp_path / name, URDF)
    assert found.causes == ("joint_order",), str(found)
    assert "joint_2 and joint_3 are exchanged" in str(found)


def header(time):
    return {"stamp": dict(zip(("sec", "nanosec"), divmod(round(time * 1e9), 10**9), strict=True))}


def named(values, names="xyz"):
    return dict(zip(names, np.asarray(values).tolist(), strict=True))


class Recorder:
    """Messages as ROS 2 records them, of the motion in basilisk_arm.py."""

    def __init__(self, path, definitions, *, every=1):
        log = pd.read_csv(ARM.with_suffix(".csv"))[::every]
        self.time = log["time"].to_numpy()
        self.place, self.speed, mrp, self.omega, self.angles, self.rates, self.torques = (
            log[[f"{name}_{i}" for i in range(3)]].to_numpy()
            for name in (
                "r_BN_N", "v_BN_N", "sigma_BN", "omega_BN_B", "theta", "thetaDot", "motorTorque",
            )
        )  # fmt: skip
        self.attitude = Rotation.from_mrp(mrp)
        self.path, self.definitions, self.messages = path, definitions, []

    def add(self, topic, kind, time, **message):
        self.messages.append((topic, kind, time, {"header": header(time)} | message))

    def poses(self, frame="arm/hub"):
        for time, p, turn in zip(self.time, self.place, self.attitude, strict=True):
            q = turn.as_quat()
            transform = {"translation": named(p), "rotation": named(q, "xyzw")}
            each = {"header": header(time), "child_frame_id": frame, "transform": transform}
            each["header"]["frame_id"] = "world"
            self.add("/tf", "tf2_msgs/msg/TFMessage", time, transforms=[each])
        return self

    def odometry(self, frame="arm/hub"):
        linear = self.attitude.apply(self.speed, inverse=True)
        rows = (self.time, self.place, self.attitude, linear, self.omega)
        for time, p, turn, v, w in zip(*rows, strict=True):
            pose = {"position": named(p), "orientation": named(turn.as_quat(), "xyzw")}
            twist = {"linear": named(v), "angular": named(w)}
            covariance = {"covariance": [0.0] * 36}
            self.add(
                "/odom", "nav_msgs/msg/Odometry", time, child_frame_id=frame,
                pose={"pose": pose} | covariance, twist={"twist": twist} | covariance,
            )  # fmt: skip
        return self

    def joints(self, *, rates=True, rows=slice(None)):
        series = (self.time, self.angles, self.rates, self.torques)
        for time, q, v, f in zip(*(each[rows] for each in series), strict=True):
            more = (v.tolist(), f.tolist()) if rates else ([], [])
            self.add(
                "/joint_states", "sensor_msgs/msg/JointState", time, name=JOINTS,
                position=q.tolist(), velocity=more[0], effort=more[1],
            )  # fmt: skip
        return self

    def write(self):
        with self.path.open("wb") as stream:
            file = writer.Writer(stream)
            schemas = {}
            for topic, kind, time, message in self.messages:
                if kind not in schemas:
                    schemas[kind] = file.register_msgdef(kind, self.definitions[kind])
                file.write_message(topic, schemas[kind], message, log_time=round(time * 1e9))
            file.finish()
        return self.path

    def audit(self):
        return audit(self.write(), ARM)


@pytest.fixture
def recorder(tmp_path, definitions):
    return Recorder(tmp_path / "log.mcap", definitions)


def test_odometry_has_the_base(recorder):
    found = recorder.odometry().joints().audit()
    assert found.is_physics, str(found)
    assert statement(found, "base velocity").startswith("in body axes")
    assert "follows the work" in statement(found, "energy")


def test_odometry_in_world_axes_is_named(recorder):
    """Its twist is in the axes of the child frame, by its definition."""
    recorder.omega = recorder.attitude.apply(recorder.omega)
    found = recorder.odometry().joints().audit()
    assert found.causes == ("axes",), str(found)
    assert "in world axes, but the log states body axes" in str(found)


def test_poses_alone_are_differentiated(recorder):
    found = recorder.poses().joints(rates=False).audit()
    assert found.is_physics, str(found)
    assert "not logged, differentiated" in statement(found, "rates")
    assert "rates of every second sample change it by" in statement(found, "momentum")


@pytest.mark.long
def test_a_mistake_in_poses_alone_is_named(recorder):
    recorder.angles[:, [0, 1]] = recorder.angles[:, [1, 0]]
    found = recorder.poses().joints(rates=False).audit()
    assert found.causes == ("joint_order",), str(found)


def test_poses_too_far_apart_are_not_judged(tmp_path, definitions):
    found = Recorder(tmp_path / "log.mcap", definitions, every=10).poses().joints(rates=False)
    found = found.audit()
    assert not found.is_physics
    assert found.causes == ()
    assert str(found).endswith("physics? cannot tell: sampling")


def test_messages_at_other_times_are_interpolated(recorder):
    """Joint states at every second sample alone, and not at the first poses."""
    found = recorder.odometry().joints(rows=slice(3, None, 2)).audit()
    said = statement(found, "time")
    assert said.startswith("197 samples, period 0.05 s; 4 rows left out")
    assert "the joints' positions, the joints' rates, the joints' efforts interpolated" in said
    assert found.is_physics, str(found)


def test_wrenches_of_the_base_are_its_forces(recorder):
    """In its axes or the world's; one in a sensor's frame is not a force from outside."""
    recorder.poses().joints()
    force, torque = np.array([1.0, 2.0, 3.0]), np.array([-0.1, 0.2, 0.3])
    kind, wrench = "geometry_msgs/msg/WrenchStamped", {"force": named(force)}
    wrench["torque"] = named(torque)
    turned = {"arm/hub": recorder.attitude, "world": Rotation.identity(), "arm/wrist": None}
    before = list(recorder.messages)
    for frame, turn in turned.items():
        recorder.messages = list(before)
        for time in recorder.time:
            recorder.add("/wrench", kind, time, wrench=wrench)
            recorder.messages[-1][3]["header"]["frame_id"] = frame
        log = read_log(recorder.write(), JOINTS, base="hub")
        if turn is None:
            assert {"force", "torque"} <= set(log.missing)
            continue
        np.testing.assert_allclose(log.force - turn.apply(force), 0.0, atol=1e-12)
        np.testing.assert_allclose(log.torque - turn.apply(torque), 0.0, atol=1e-12)


def test_logs_that_cannot_be_read(recorder, folder, tmp_path, monkeypatch):
    recorder.poses("left/hub").poses("right/hub").joints()
    with pytest.raises(RecordError, match=r"several frames are called 'hub'; name one with"):
        recorder.audit()
    found = audit(recorder.path, ARM, columns={"base": "right/hub"})
    assert found.is_physics, str(found)
    with pytest.raises(RecordError, match=r"no frame 'mine'.* there are \['left/hub', 'right/hub'"):
        audit(recorder.path, ARM, columns={"base": "mine"})
    (tmp_path / "bad.mcap").write_bytes(recorder.path.read_bytes()[:3000])
    with pytest.raises(RecordError, match="cannot be read"):
        audit(tmp_path / "bad.mcap", ARM)
    for name, extra in {"run.mcap": "mcap", "ros2.mcap": "ros2"}.items():
        with monkeypatch.context() as patch:
            package = "mcap_protobuf" if extra == "mcap" else "mcap_ros2"
            patch.setitem(sys.modules, f"{package}.decoder", None)
            with pytest.raises(FfsmError, match=rf"pip install 'ffsm-drake\[{extra}\]'"):
                audit(folder / name, URDF)


def test_a_log_is_not_unpacked_beyond_a_bound(tmp_path, monkeypatch):
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        for k in range(100):
            writer.add_message(channel, k, json.dumps({"value": 10_000 * "0"}).encode(), k)
        writer.finish()
    monkeypatch.setattr(mcap, "_MAX_UNPACKED", 100_000)
    assert path.stat().st_size < 100_000
    with pytest.raises(ValueError, match="unpacked; at most 1e\\+05 are read"):
        mcap.read_mcap(path, "base")
