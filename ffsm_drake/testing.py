"""A conformance kit for user-supplied controllers and other blocks, for use in their tests.

from ffsm_drake.testing import check_block, check_controller
from my_module import MyController, Vicon

def test_my_controller():
    check_controller(MyController)

def test_my_sensors():
    check_block("sensing", Vicon)
"""

import dataclasses
import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import System

from ffsm_drake.common.errors import BlockError, FfsmError
from ffsm_drake.common.guard import guarded
from ffsm_drake.loop.blocks import check_ports
from ffsm_drake.mission import Mission
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import (
    PerCoordinate,
    Posture,
    Scenario,
    controller_key,
    load_scenario,
    override_scenario,
    scenario_from_dict,
    scenario_to_dict,
)
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.systems.controllers import make_controller
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import Factory, find_factory, name_of

_SAMPLES = 25
Sample = dict[str, np.ndarray]  # inputs of a controller, by port


class ConformanceError(AssertionError):
    """A block breaks the contract; the text names the part, the fault, and the remedy."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Conformance:
    """The checks that passed, and the block's cost."""

    name: str
    checks: tuple[str, ...]
    # s: a controller's time per update, fastest of several runs; for other blocks, the closed
    # loop's per sample
    update_time: float

    def __str__(self) -> str:
        passed = "\n".join(f"  {check}" for check in self.checks)
        return f"{self.name} conforms ({1e6 * self.update_time:.0f} us per sample):\n{passed}"


def _users(error: FfsmError) -> BaseException | None:
    """The user's exception that caused an error, which a traceback shows; None: there is none."""
    return None if isinstance(error.__cause__, FfsmError) else error.__cause__


def check_controller(
    factory: Factory | str,
    *,
    scenario: str | Path | Scenario = "postcapture",
    gains: Mapping[str, PerCoordinate] | None = None,
) -> Conformance:
    """Check a controller against the contract of the closed loop.

    Ports and sizes; a force that is finite and held over each period; no memory outside the context
    (a reset and a second run give the same force, two runs do not disturb each other); forces that
    follow the joints' names if the model lists them in another order; an update time below the
    period. A further line reports an adaptation of K_s that the analyses do not cover.

    Args:
      factory: the law's class, a function (BlockSetup -> control law or Drake system), or a name
        (see ``--controller``).
      scenario: the spacecraft to check it with.
      gains: gains as under ``controllers.<name>`` in a scenario.

    Raises:
      ConformanceError: the first part of the contract that is broken.
    """
    base = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    checks: tuple[Callable[[_Candidate, Scenario], str], ...] = (
        _check_ports, _check_finite, _check_memory, _check_sampling, _check_names,
        _check_adaptation,
    )  # fmt: skip
    try:
        if isinstance(factory, str):
            name, factory = controller_key(factory), find_factory("controller", factory)
        else:
            name = name_of(factory)
        candidate = _Candidate(name=name, factory=factory, gains=gains or {})
        with guarded:
            passed = [found for check in checks if (found := check(candidate, base))]
            cost = _update_time(candidate, base)
    except FfsmError as error:
        raise ConformanceError(str(error)) from _users(error)
    if cost > base.sample_time:
        raise ConformanceError(
            f"{candidate}: an update takes {1e3 * cost:.1f} ms, more than the period of "
            f"{1e3 * base.sample_time:g} ms"
        )
    return Conformance(name=name, checks=tuple(passed), update_time=cost)


def check_block(
    block: str,
    factory: Factory,
    *,
    scenario: str | Path | Scenario = "postcapture",
    settings: Mapping[str, Any] | None = None,
) -> Conformance:
    """Check a user-supplied block in the closed loop; for controllers see ``check_controller``.

    Ports and sizes; finite signals; no memory outside the context (a second run, and a
    second closed loop, give the same bits).

    Args:
      block: "reference", "sensing", "actuation", or "forces.<name>".
      factory: BlockSetup -> Drake system.
      scenario: the spacecraft to check it with.
      settings: the block's settings in a scenario.

    Raises:
      ConformanceError: the first part of the contract that is broken.
    """
    base = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    place = f"blocks.{block} '{name_of(factory)}'"
    base = dataclasses.replace(base, duration=_SAMPLES * base.sample_time)
    if settings:
        key = "sensing.sensing" if block == "sensing" else block
        base = scenario_from_dict(
            scenario_to_dict(base),
            [f"blocks.{key}={json.dumps({'system': 'given', 'settings': dict(settings)})}"],
        )
    try:
        rollout = make_rollout(base, blocks={block: factory})
        first = rollout.run()
        for name, values in first.series.items():
            if not np.isfinite(values).all():
                raise BlockError(
                    f"{place}: '{name}' is not finite in the closed loop; {first.outcome.message}"
                )
        for again, when in (
            (
                rollout.run(),
                "a second run differs from the first: keep memory in the context, not on self",
            ),
            (
                make_rollout(base, blocks={block: factory}).run(),
                "two closed loops differ: keep no state in module or class",
            ),
        ):
            if any(
                not np.array_equal(again.series[name], values)
                for name, values in first.series.items()
            ):
                raise BlockError(f"{place}: {when}; draw random numbers from a RandomSource")
    except FfsmError as error:
        raise ConformanceError(str(error)) from _users(error)
    return Conformance(
        name=place,
        checks=("ports: names and sizes", "finite signals", "no memory outside the context"),
        update_time=first.wall_time["advance_to"] / _SAMPLES,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Candidate:
    name: str
    factory: Factory
    gains: Mapping[str, PerCoordinate]

    def build(self, scenario: Scenario) -> System:
        key = name_of(self.factory)
        mission = Mission(dataclasses.replace(scenario, controllers={key: dict(self.gains)}))
        controller = make_controller(mission, mission.craft.nominal(), self.factory)
        check_ports(controller, "controller", mission.craft.coordinates, place=str(self))
        return controller

    def run(self, scenario: Scenario, samples: Sequence[Sample]) -> np.ndarray:
        """The forces (n, nv) of a new controller."""
        return _Bench(self.build(scenario), scenario.sample_time).run(samples)

    def __str__(self) -> str:
        return f"controller '{self.name}'"


class _Bench:
    """A controller alone, with given inputs sample by sample."""

    def __init__(self, controller: System, sample_time: float) -> None:
        self._controller = controller
        self._sample_time = sample_time
        self._simulator = Simulator(controller, controller.CreateDefaultContext())
        self._sample = 0

    def step(self, inputs: Sample, *, later: Sample | None = None) -> np.ndarray:
        """The force (nv) after one sample with inputs; at mid-period with ``later`` if given."""
        context = self._simulator.get_mutable_context()
        self._set(inputs)
        if self._sample == 0:
            self._simulator.Initialize()
        self._simulator.AdvancePendingEvents()
        self._sample += 1
        if later is not None:
            self._simulator.AdvanceTo((self._sample - 0.5) * self._sample_time)
            self._set(later)
        force = np.array(self._controller.GetOutputPort("generalized_force").Eval(context))
        self._simulator.AdvanceTo(self._sample * self._sample_time)
        return force

    def run(self, samples: Sequence[Sample]) -> np.ndarray:
        """The forces (n, nv) after each sample."""
        return np.array([self.step(sample) for sample in samples])

    def _set(self, inputs: Sample) -> None:
        context = self._simulator.get_mutable_context()
        for i in range(self._controller.num_input_ports()):
            port = self._controller.get_input_port(i)
            port.FixValue(context, inputs[port.get_name()])


def _inputs(scenario: Scenario, *, seed: int) -> list[Sample]:
    """Samples along the planned motion with small random errors."""
    mission = Mission(scenario)
    nominal, reference = mission.craft.nominal(), make_motion(mission)
    coordinates, frame = nominal.coordinates, goal_frame(scenario, nominal.plant)
    random = np.random.default_rng(seed)
    samples = []
    for k in range(_SAMPLES):
        q_d, v_d, a_d = reference.evaluate(reference.part(0.3) + k * scenario.sample_time)
        noise = 1e-3 * random.standard_normal((3, len(coordinates.names)))
        q, v = q_d.copy(), v_d + noise[1]
        q[4:] += noise[0, 3:]
        q[1:4] += 0.5 * noise[0, :3]
        q[:4] /= np.linalg.norm(q[:4])
        samples.append(
            {
                "estimated_state": np.concatenate([q, v]),
                "desired_state": np.concatenate([q_d, v_d]),
                "desired_acceleration": a_d,
                "applied_force": noise[2],
                "measurement_is_new": np.ones(q.size + v.size),
                "desired_frame": nominal.calc_frame_motion(q_d, v_d, a_d, frame),
            }
        )
    return samples


def _reordered(samples: list[Sample], order: np.ndarray) -> list[Sample]:
    """The same samples for a model with its coordinates in another ``order`` (nv)."""
    # the quaternion has one number more
    states = np.concatenate([[0], 1 + order, order.size + 1 + order])
    orders = {order.size: order, states.size: states}
    return [
        {
            name: value if name == "desired_frame" else value[orders[value.size]]
            for name, value in sample.items()
        }
        for sample in samples
    ]


def _check_ports(candidate: _Candidate, scenario: Scenario) -> str:
    controller = candidate.build(scenario)
    if controller.num_continuous_states() > 0:
        raise BlockError(
            f"{candidate} has continuous state; a sampled controller keeps discrete state"
        )
    return "ports: names and sizes"


def _check_finite(candidate: _Candidate, scenario: Scenario) -> str:
    for seed in (0, 1):
        samples = _inputs(scenario, seed=seed)
        at_rest = [sample | {"estimated_state": sample["desired_state"]} for sample in samples]
        for situation, given in (("small errors", samples), ("no error at all", at_rest)):
            force = candidate.run(scenario, given)
            if not np.isfinite(force).all():
                sample = int(np.argmin(np.isfinite(force).all(axis=1)))
                raise BlockError(
                    f"{candidate}: the force is not finite at sample {sample} with {situation}"
                )
    return "finite force, with errors and without any"


def _check_sampling(candidate: _Candidate, scenario: Scenario) -> str:
    samples, others = _inputs(scenario, seed=2), _inputs(scenario, seed=3)
    force = candidate.run(scenario, samples)
    bench = _Bench(candidate.build(scenario), scenario.sample_time)
    held = np.array(
        [bench.step(sample, later=other) for sample, other in zip(samples, others, strict=True)]
    )
    if not np.array_equal(force, held):
        raise BlockError(
            f"{candidate}: the force follows its inputs between two samples; output a discrete "
            "state (DeclareStateOutputPort), updated every sample_time"
        )
    if all(np.array_equal(force[0], later) for later in force[1:]):
        raise BlockError(
            f"{candidate}: the force never changes; declare a periodic update every "
            f"sample_time ({scenario.sample_time:g} s), offset 0"
        )
    return "one update per period, the force held in between"


def _check_memory(candidate: _Candidate, scenario: Scenario) -> str:
    samples, others = _inputs(scenario, seed=4), _inputs(scenario, seed=5)
    first = candidate.run(scenario, samples)
    if not np.array_equal(first, candidate.run(scenario, samples)):
        raise BlockError(
            f"{candidate}: two new controllers give different forces for the same inputs; draw "
            "random numbers from an input port, and keep no state in module or class"
        )
    remedy = "a controller must keep its state in the context (discrete state), not on self"
    controller = candidate.build(scenario)
    _Bench(controller, scenario.sample_time).run(others)
    again = _Bench(controller, scenario.sample_time).run(samples)
    if not np.array_equal(first, again):
        where = int(np.argmin((first == again).all(axis=1)))
        raise BlockError(
            f"{candidate} hides state on self: after a reset, the force at sample {where} "
            f"depends on the run before; {remedy}"
        )
    controller = candidate.build(scenario)
    one, two = (_Bench(controller, scenario.sample_time) for _ in range(2))
    interleaved = []
    for sample, other in zip(samples, others, strict=True):
        interleaved.append(one.step(sample))
        two.step(other)
    if not np.array_equal(first, np.array(interleaved)):
        raise BlockError(
            f"{candidate} hides state on self: two runs at once disturb each other; {remedy}"
        )
    return (
        "no state outside the context: reset, second run and two runs at once give the same force"
    )


def _check_names(candidate: _Candidate, scenario: Scenario) -> str:
    with tempfile.TemporaryDirectory() as folder:
        one = two_armed(scenario, ("left", "right"), Path(folder) / "left_first.urdf")
        two = two_armed(scenario, ("right", "left"), Path(folder) / "right_first.urdf")
        listed, otherwise = (Craft(model).coordinates.names for model in (one, two))
        order = np.array([listed.index(name) for name in otherwise])
        samples = _inputs(one, seed=6)
        first = candidate.run(one, samples)
        second = candidate.run(two, _reordered(samples, order))
    back = second[:, np.argsort(order)]
    if not np.allclose(first, back, rtol=1e-6, atol=1e-9 * max(1.0, float(np.abs(first).max()))):
        worst = listed[int(np.argmax(np.abs(first - back).max(axis=0)))]
        raise BlockError(
            f"{candidate}: the force on '{worst}' depends on the order of the joints in the "
            "model; give gains by name, with gain(...) or setup.coordinates.vector"
        )
    return "forces follow the joints' names, not their order"


def _check_adaptation(candidate: _Candidate, scenario: Scenario) -> str:
    """Empty for a controller without a law, or without the plug-in that analyses it."""
    judge, law = JUDGES.first(), getattr(candidate.build(scenario), "law", None)
    uncovered = judge.uncovered(Mission(scenario), law) if judge and law else ""
    return uncovered and f"not covered by the stability analysis: {uncovered}"


def two_armed(scenario: Scenario, names: tuple[str, str], urdf: Path) -> Scenario:
    """A spacecraft with two one-joint arms, listed in the given order; the left one holds the
    debris.
    """
    urdf.write_text(_two_arms(names), encoding="utf-8")
    target = Posture(
        base_position=[0.1, -0.2, 0.3],
        base_rpy=[0.1, 0.2, -0.1],
        joints={"left": 0.5, "right": -0.2},
    )
    blank = Scenario(
        sample_time=scenario.sample_time,
        reference=scenario.reference,
        initial_posture=Posture(),
        target_posture=target,
    )
    return override_scenario(
        blank, [f"model.servicer={urdf}", "model.end_effector=servicer::left_link"]
    )


def _two_arms(names: tuple[str, str]) -> str:
    """URDF of a base with two one-joint arms of different mass, listed in the given order."""

    def link(name: str, mass: float, size: float) -> str:
        inertia = mass * size**2 / 6.0
        return (
            f'<link name="{name}"><inertial><mass value="{mass}"/>'
            f'<inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" '
            'iyz="0"/></inertial></link>'
        )

    arms = {
        "left": (link("left_link", 20.0, 0.5), "0 1 0", "0 1 0"),
        "right": (link("right_link", 45.0, 0.8), "0 -1 0", "0 0 1"),
    }
    parts = [link("base", 400.0, 2.0)]
    for name in names:
        text, place, axis = arms[name]
        parts.append(
            f'{text}<joint name="{name}" type="revolute"><parent link="base"/><child '
            f'link="{name}_link"/>'
            f'<origin xyz="{place}"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="0" '
            'velocity="0"/></joint>'
        )
    return f'<robot name="two_arms">{"".join(parts)}</robot>'


def _update_time(candidate: _Candidate, scenario: Scenario) -> float:
    samples = _inputs(scenario, seed=7)
    best = np.inf
    for _ in range(3):
        bench = _Bench(candidate.build(scenario), scenario.sample_time)
        bench.step(samples[0])
        start = time.perf_counter()
        bench.run(samples)
        best = min(best, (time.perf_counter() - start) / len(samples))
    return float(best)
