"""A run as MCAP, read back by other libraries."""

import collections
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.cli import main

pytest.importorskip("foxglove", reason="needs foxglove-sdk")
reader = pytest.importorskip("mcap_protobuf.reader", reason="needs mcap-protobuf-support")

from mcap.reader import make_reader  # noqa: E402

GRASP = 20.0


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    scenario = load_scenario(
        "tumbling_capture", ["duration=20.2", "model.flexible={}", "tolerance={all: 1}"]
    )
    simulate(scenario, check_stability=False).save(folder)
    result = CliRunner().invoke(main, ["export", str(folder / "run.mcap"), str(folder)])
    assert result.exit_code == 0, result.output
    topics = collections.defaultdict(list)
    for message in reader.read_protobuf_messages(
        str(folder / "run.mcap"), topics=["/tf", "/scene", "/joint_states", "/events"]
    ):
        topics[message.topic].append((message.log_time_ns, message.proto_msg))
    return RunRecord.load(folder), folder / "run.mcap", topics


def pose(transform):
    q, p = transform.rotation, transform.translation
    return RigidTransform(Quaternion(q.w, q.x, q.y, q.z), [p.x, p.y, p.z])


@pytest.mark.long
def test_bodies_are_where_the_record_has_them(run):
    record, _, topics = run
    data = record.dataset
    assert len(topics["/tf"]) == data.time.size
    for k in (0, 700, data.time.size - 1):
        time, message = topics["/tf"][k]
        assert time == round(float(data.time[k]) * 1e9)
        frames = {each.child_frame_id: pose(each) for each in message.transforms}
        assert {each.parent_frame_id for each in message.transforms} == {"world"}
        base = frames["servicer::base"]
        np.testing.assert_allclose(base.translation(), data.position[k, 4:7], atol=1e-12)
        target = frames[record.scenario.payload.body].translation()
        if data.time[k] < GRASP:
            np.testing.assert_allclose(target, data.target_position[k], atol=1e-12)


def test_the_scene_has_every_drawn_body_once(run):
    _, _, topics = run
    ((_, scene),) = topics["/scene"]
    names = [each.id for each in scene.entities]
    assert len(set(names)) == len(names) >= 6
    assert all(each.frame_locked and each.frame_id == each.id for each in scene.entities)
    frames = {each.child_frame_id for each in topics["/tf"][0][1].transforms}
    assert set(names) <= frames


def test_joints_and_events(run):
    record, _, topics = run
    _, last = topics["/joint_states"][-1]
    data = record.dataset
    for joint in last.joints:
        assert joint.velocity == data.velocity.sel(coordinate=joint.name).values[-1]
        assert joint.effort == data.applied_force.sel(coordinate=joint.name).values[-1]
    texts = [message.message for _, message in topics["/events"]]
    assert any("stop" in text for text in texts)
    assert texts[-1] == record.ending.sentence


def test_series_and_attachments(run):
    record, path, _ = run
    with path.open("rb") as stream:
        read = make_reader(stream)
        names = {each.name for each in read.iter_attachments()}
        counts = collections.Counter(
            channel.topic for _, channel, _ in read.iter_messages(topics=["/error", "/velocity"])
        )
    assert "scenario.yaml" in names
    assert any(name.endswith(".urdf") for name in names)
    assert counts["/error"] == counts["/velocity"] == record.dataset.time.size


def test_without_the_library_one_line_says_what_to_install(run, tmp_path, monkeypatch):
    _, path, _ = run
    monkeypatch.setitem(sys.modules, "foxglove", None)
    result = CliRunner().invoke(main, ["export", str(tmp_path / "a.mcap"), str(path.parent)])
    assert result.exit_code == 2
    assert "pip install 'ffsm-drake[mcap]'" in result.output
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_ros_2_reads_it(run, tmp_path):
    ros2 = pytest.importorskip("mcap_ros2.reader", reason="needs mcap-ros2-support")
    record, path, topics = run
    line = ["export", str(tmp_path / "ros.mcap"), str(path.parent), "--ros2"]
    result = CliRunner().invoke(main, line)
    assert result.exit_code == 0, result.output
    found = collections.defaultdict(list)
    for message in ros2.read_ros2_messages(str(tmp_path / "ros.mcap")):
        found[message.channel.topic].append(message.ros_msg)
    assert {len(messages) for messages in found.values()} == {record.dataset.time.size}
    for ours, theirs in zip(found["/tf"][::500], topics["/tf"][::500], strict=True):
        for one, other in zip(ours.transforms, theirs[1].transforms, strict=True):
            assert one.child_frame_id == other.child_frame_id
            for name in "xyzw":
                part = getattr(one.transform.rotation, name)
                assert part == pytest.approx(getattr(other.rotation, name), abs=1e-15)
    last = found["/joint_states"][-1]
    speeds = record.dataset.velocity.sel(coordinate=last.name).values[-1]
    np.testing.assert_array_equal(last.velocity, speeds)
    force = record.dataset.applied_force.values[-1, 3:6]
    pull = found["/wrench"][-1].wrench.force
    np.testing.assert_array_equal([pull.x, pull.y, pull.z], force)
