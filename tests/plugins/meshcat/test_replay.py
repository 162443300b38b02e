"""A record on the screen: the recorded page, and the force arrows."""

import base64
import dataclasses
import re

import flight_settings
import numpy as np
import pytest
from browser import answer_of, needs_chromium
from meshcat_page import transform
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.numbers import number
from ffsm_drake.plugins.meshcat.arrows import ARROW_KINDS, legend
from ffsm_drake.plugins.meshcat.recording import recording_html
from ffsm_drake.plugins.meshcat.replay_view import ReplayView
from ffsm_drake.plugins.meshcat.solids import SwitchedSolids, solids_of
from ffsm_drake.plugins.meshcat.stage import start_meshcat
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import load_scenario, thruster_layouts
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.plan import load_plan


@pytest.fixture(scope="module")
def meshcat():
    return start_meshcat()


@pytest.fixture
def record(run):
    return run("postcapture", "duration=2")


def view(meshcat, record, **options):
    meshcat.Delete()
    return ReplayView(
        meshcat, record, **({"ghost": False, "path": False, "forces": False} | options)
    )


def animation_of(page):
    """(frames per second, last frame) of the animation in a recorded page."""
    commands = b"".join(
        base64.b64decode(text) for text in re.findall(r"base64,([A-Za-z0-9+/]{40,}=*)", page)
    )
    (fps,) = {
        float(np.frombuffer(number, ">f8")[0])
        for number in re.findall(rb"\xa3fps\xcb(.{8})", commands, re.S)
    }
    # msgpack's integers: one byte below 128, else a length byte and the number.
    frames = re.findall(rb"\xa4time([\x00-\x7f]|\xcc.|\xcd..)", commands, re.S)
    return fps, max(int.from_bytes(number if len(number) == 1 else number[1:]) for number in frames)


# Plays to the end, moves the slider, goes on, stops; tells the server each time what the bar shows.
HAND = """
  const [slider, button, clock] = ["time", "play", "clock"].map(
    (id) => document.getElementById(id));
  const shown = [], look = () => shown.push([clock.textContent, button.textContent.at(-1)]);
  await until(() => viewer.animator.playing && button.textContent === "Pause"); look();
  await until(() => button.textContent !== "Pause"); look();
  slider.value = 0.5; slider.oninput();
  await until(() => clock.textContent.includes(" 0.5 ")); look();
  button.click();
  await until(() => parseFloat(clock.textContent.slice(4)) > 0.6); look();
  button.click();
  await until(() => button.textContent !== "Pause"); look();
  return shown;
"""
# Changes the speed, hides the second arrow, and stops with the space bar.
KEYS = """
  const box = document.querySelectorAll("#caption input")[1];
  const arrow = viewer.scene_tree.find(["drake", "forces", "applied torque"]).object;
  const rate = document.getElementById("rate");
  await until(() => viewer.animator.playing);
  const shown = [rate.value, arrow.visible];
  rate.value = "0.5"; rate.onchange(); box.click();
  document.body.dispatchEvent(new KeyboardEvent("keydown", {code: "Space", bubbles: true}));
  await until(() => !viewer.animator.playing);
  return [...shown, viewer.animator.mixer.timeScale, arrow.visible];
"""


@pytest.mark.slow
@needs_chromium
def test_the_page_has_a_speed_boxes_for_arrows_and_the_space_bar(record, tmp_path):
    page = recording_html(record, speed=3.0, forces=True)
    assert answer_of(page, KEYS, tmp_path)[0] == ["3", True, 0.5 / 3.0, False]


@pytest.mark.slow
@needs_chromium
def test_the_page_shows_time_and_controls(record, tmp_path):
    shown, _ = answer_of(recording_html(record, speed=2.0), HAND, tmp_path)
    times = [float(re.fullmatch(r"t = (\d\.\d) of 2\.0 s", clock)[1]) for clock, _ in shown]
    assert [word for _, word in shown] == ["e", "y", "y", "e", "y"]  # Pause, Play
    assert times[1] == 2.0
    assert times[2] == 0.5
    assert 0.6 < times[3] <= times[4] < 2.0


@pytest.mark.slow
def test_the_page_plays_at_the_asked_speed(record):
    for speed in (1.0, 2.0, 0.25):
        page = recording_html(record, speed=speed)
        assert page.startswith("<!DOCTYPE html>")
        assert f'<option value="{speed:g}" selected>' in page
        fps, last_frame = animation_of(page)
        assert last_frame / fps == pytest.approx(2.0 / speed, abs=1.0 / fps)


@pytest.mark.smoke
def test_frames_show_the_instants_that_are_due(record, monkeypatch):
    shown = []
    show = ReplayView.show

    def noted(view, time, *, time_in_recording=None):
        shown.append((time, time_in_recording))
        show(view, time, time_in_recording=time_in_recording)

    monkeypatch.setattr(ReplayView, "show", noted)
    recording_html(record, speed=2.0)
    run_times, page_times = np.array(shown[1:]).T
    assert np.floor(page_times * 25.0) / 25.0 * 2.0 == pytest.approx(run_times)
    assert run_times[0] == 0.0
    assert run_times[-1] == pytest.approx(2.0)


@pytest.mark.slow
def test_the_page_holds_what_was_asked_for(record):
    full = recording_html(record, speed=4.0)
    assert len(recording_html(record, speed=4.0, ghost=False)) < len(full)
    assert len(recording_html(record, speed=4.0, path=False)) < len(full)
    forces = recording_html(record, speed=4.0, forces=True)
    assert len(forces) > len(full)
    assert "applied torque" in forces
    assert "applied torque" not in full


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.smoke
def test_a_bad_speed_gets_one_line(record, speed):
    with pytest.raises(FfsmError, match="speed: must be > 0"):
        recording_html(record, speed=speed)


def test_parts_that_are_not_asked_for_are_not_there(meshcat, record):
    view(meshcat, record)
    assert not any(map(meshcat.HasPath, ("target_posture", "end_effector_path", "forces")))
    assert meshcat.HasPath("visualizer")
    view(meshcat, record, ghost=True, path=True, forces=True)
    assert all(
        map(meshcat.HasPath, ("target_posture", "end_effector_path", "forces", "visualizer"))
    )


def test_arrows_point_along_their_forces_and_measure_them(meshcat, record):
    shown = view(meshcat, record, forces=True)
    data = record.dataset
    for sample in (0, 57, 200):
        shown.show(data["time"].values[sample])
        q = data["position"].values[sample]
        for kind, magnification in zip(ARROW_KINDS, shown.arrows.magnifications, strict=True):
            names = [f"{kind.coordinates}_{axis}" for axis in "xyz"]
            vectors = data[kind.variable].sel(coordinate=names).values
            control = data["applied_force"].sel(coordinate=names).values
            arrow = transform(meshcat, kind.path)
            length = transform(meshcat, f"{kind.path}/tip")[2, 3]
            direction = vectors[sample] / np.linalg.norm(vectors[sample])
            assert arrow[:3, 2] == pytest.approx(direction, abs=1e-6)
            longest = shown.arrows._longest
            of_peak = np.linalg.norm(vectors[sample]) / np.linalg.norm(control, axis=1).max()
            assert length == pytest.approx(longest * magnification * of_peak, rel=1e-6)
            assert length < longest * (1 + 1e-9)
            if not kind.is_torque:  # its line of action goes through the base's origin
                line = arrow[:3, 3] - q[4:7]
                assert np.cross(line, direction) == pytest.approx(np.zeros(3), abs=1e-6)
                assert 0.0 < line @ direction < 2.0 * longest


def test_arrows_start_on_the_surface_of_the_base(meshcat, record):
    """Inside its bounding box a little before the tail, outside a little after."""
    shown = view(meshcat, record, forces=True)
    q = record.dataset["position"].values[0]
    arrow = transform(meshcat, ARROW_KINDS[0].path)
    rotation = RotationMatrix(Quaternion(q[:4])).matrix()
    to_box = shown.arrows._box_pose.inverse().GetAsMatrix4()
    for step, inside in ((-1e-3, True), (1e-3, False)):
        in_base = rotation.T @ (arrow[:3, 3] + step * arrow[:3, 2] - q[4:7])
        in_box = (to_box @ [*in_base, 1.0])[:3]
        assert bool(np.all(np.abs(in_box) < shown.arrows._box_half_width)) == inside


def test_the_legend_names_colour_magnification_and_the_peak_of_the_table(meshcat, record):
    shown = view(meshcat, record, forces=True).arrows
    for kind, factor, text in zip(ARROW_KINDS, shown.magnifications, legend(shown), strict=True):
        force = record.dataset[kind.variable]
        peak = np.abs(force.where(force["group"] == kind.coordinates, drop=True).values).max()
        times = f" x {factor}" if factor > 1 else ""
        assert text == (
            f"{kind.color_name}: {kind.label}{times}, peak {number(peak)} {kind.unit}"
        )  # fmt: skip
    assert shown.magnifications[2] > 1


def test_a_run_without_disturbance_has_arrows(meshcat, run):
    shown = view(
        meshcat, run("postcapture", "duration=0.2", "disturbance.amplitude_scale=0"), forces=True
    )
    assert shown.arrows.magnifications == [1, 1, 1, 1]
    assert transform(meshcat, f"{ARROW_KINDS[2].path}/tip")[2, 3] == 0.0


def test_a_record_that_ends_in_no_numbers_is_shown_up_to_there(meshcat, record):
    broken = record.dataset.copy(deep=True)
    broken["position"].values[150:] = np.nan
    broken["applied_force"].values[149] = np.nan
    broken = dataclasses.replace(record, dataset=broken)
    shown = view(meshcat, broken, forces=True, path=True)
    assert shown.duration == pytest.approx(1.49)
    shown.show(shown.duration)
    assert np.isfinite(shown.arrows.peaks).all()
    assert "peak nan" not in recording_html(broken, forces=True)


@pytest.fixture
def firing(run):
    wheels = "{units: {up: {axis: [0, 0, 2]}, x: {axis: [1, 0, 0]}, y: {axis: [0, 1, 0]}}}"
    short = ("duration=1", "actuation.thrusters.layout=12x5N", f"actuation.wheels={wheels}")
    return run(*flight_settings.FLIGHT, *flight_settings.NO_NOISE, *short)


def test_thrusters_and_wheels_are_drawn_on_the_base(meshcat, firing):
    base = view(meshcat, firing).spacecraft.base_path
    for name, unit in thruster_layouts()["12x5N"].items():
        for kind in ("thrusters", "plumes"):
            pose = transform(meshcat, f"{base}/{kind}/{name}")
            assert pose[:3, 3] == pytest.approx(unit.position)
            # the cone opens against the force
            assert pose[:3, 2] == pytest.approx(-np.array(unit.direction))
    wheel = transform(meshcat, f"{base}/wheels/up")
    assert wheel[:3, 2] == pytest.approx([0.0, 0.0, 1.0])
    page = recording_html(firing)
    assert "pale cones: open thrusters; discs in the base: reaction wheels" in page


def test_a_plume_is_seen_in_the_pictures_in_whose_time_its_thruster_opens(meshcat, firing):
    shown = view(meshcat, firing)
    opened, seen = firing.dataset["thruster_open"].values > 0.0, []
    for sample in range(0, 100, 4):  # 25 pictures a second
        shown.show(sample * 0.01)
        packed = [
            meshcat._GetPackedProperty(f"{shown.spacecraft.base_path}/plumes/{name}", "visible")
            for name in firing.dataset["thruster"].values
        ]
        seen.append([each.endswith(b"\xc3") for each in packed])  # msgpack's true
        assert seen[-1] == opened[sample : sample + 4].any(axis=0).tolist()
    assert 0.02 < np.mean(seen) < 0.98


def test_a_recording_tells_only_when_plumes_change():
    told = []

    class Page:
        def SetProperty(self, *words):
            told.append(words)

        def SetObject(self, *_):
            pass

        SetTransform = SetObject

    scenario = load_scenario("postcapture", ["actuation.thrusters.layout=12x5N"])
    cones = [solid for solid in solids_of(scenario) if solid.shown_by][:2]
    opened = np.array([[0, 1], [0, 1], [1, 1], [0, 1], [0, 0], [0, 0], [0, 0]], dtype=bool)
    plumes = SwitchedSolids(Page(), "base", cones, opened, longest=1.0)
    plumes.show(0, 2)  # before the recording
    assert told == [
        ("base/plumes/a_x", "visible", False, None),
        ("base/plumes/a_y", "visible", True, None),
    ]
    told.clear()
    for frame in range(4):
        plumes.show(2 * frame, 2, time_in_recording=frame)
    first, second = "base/plumes/a_x", "base/plumes/a_y"
    assert told == [
        (first, "visible", False, 0), (second, "visible", True, 0), (first, "visible", True, 1),
        (first, "visible", False, 2), (second, "visible", False, 2),
    ]  # fmt: skip


@pytest.fixture
def captured(run):
    near = "{joint_1: 0.15, joint_2: 0.33, joint_3: 1.1, joint_4: 0.5, joint_5: -0.75}"
    posture = f"{{base_position: [0.1, 0.3, -0.2], base_rpy: [0.11, 0.08, -0.1], joints: {near}}}"
    return run(
        "tumbling_capture", "duration=2.5", f"capture.approach={{duration: 2, posture: {posture}}}"
    )


@pytest.mark.slow
def test_up_to_the_grasp_the_target_is_apart(meshcat, captured):
    shown, data = view(meshcat, captured), captured.dataset
    path = (
        "/drake/visualizer/debris/debris"
        if meshcat.HasPath("/drake/visualizer/debris/debris")
        else None
    )
    path = path or "visualizer/debris/debris"
    for time, phase in ((1.0, "approach"), (2.3, "stop")):
        shown.show(time)
        sample = data.isel(time=round(time / 0.01))
        assert str(sample["phase"].values) == phase
        matrix = transform(meshcat, path)
        assert matrix[:3, 3] == pytest.approx(sample["target_position"].values, abs=1e-6)
        attitude = RotationMatrix(Quaternion(sample["target_quaternion"].values)).matrix()
        assert matrix[:3, :3] == pytest.approx(attitude, abs=1e-6)
    apart = np.linalg.norm(
        data["target_position"].values - data["end_effector_position"].values, axis=1
    )
    assert np.abs(apart[:50] - 0.5).min() > 0.01  # not yet at the grasp, 0.5 m from its centre
    assert apart[200:] == pytest.approx(0.5, abs=2e-3)
    assert "grasp at t = 2 s" in recording_html(captured)


def test_a_live_run_shows_the_target_apart(meshcat, captured):
    meshcat.Delete()
    seen = []
    rollout = make_rollout(captured.scenario, meshcat=meshcat)
    rollout.run(
        progress=lambda time, _: seen.append((time, transform(meshcat, "visualizer/debris/debris")))
    )
    times = [time for time, _ in seen]
    assert times == sorted(times)
    assert (times[0], times[-1]) == pytest.approx((0.0, 2.5))
    for time, matrix in seen[:2]:
        sample = captured.dataset.isel(time=round(time / 0.01))
        assert matrix[:3, 3] == pytest.approx(sample["target_position"].values, abs=1e-6)
        attitude = RotationMatrix(Quaternion(sample["target_quaternion"].values)).matrix()
        assert matrix[:3, :3] == pytest.approx(attitude, abs=2e-3)  # frames are 1/64 s apart
    rollout.release()


def test_the_ghost_stands_where_a_plan_ends(meshcat, run):
    record = run("planar_detumble", "duration=0.5")
    view(meshcat, record, ghost=True)
    plan = load_plan(
        record.scenario.reference.plan, Coordinates(("joint_1", "joint_2", "joint_3"), ("rad",) * 3)
    )
    last = plan.rows(np.array([plan.end]))[0]
    assert transform(meshcat, "target_posture/servicer/base")[:3, 3] == pytest.approx(
        last[4:7], abs=1e-6
    )
    assert np.linalg.norm(last[4:7]) > 0.01  # it starts at the origin
