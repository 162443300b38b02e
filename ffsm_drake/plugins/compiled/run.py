"""What a compiled run depends on: its code, and its numbers."""

import collections
import copy
import dataclasses
import functools
import json
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from pydrake.systems.framework import System

from ffsm_drake.common.memo import content_of
from ffsm_drake.common.plugins import SERVICES, optional
from ffsm_drake.loop.blocks import DISTURBANCE, factory_of, settle_faults
from ffsm_drake.plugins.compiled.blocks import (
    Blocks,
    Parts,
    kept_at,
    phases_at,
    row,
    sampled_of,
)
from ffsm_drake.plugins.compiled.noise import Noise, noise_of
from ffsm_drake.plugins.compiled.parameters import parameters_of, reader_of, rows_of
from ffsm_drake.plugins.compiled.schemes import steps_of
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import HELD, Block, Grip, MassProperties, Scenario, scenario_to_dict
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import Carrier, make_flexible_plant, make_nominal_plant
from ffsm_drake.spacecraft.plant import files_read
from ffsm_drake.spacecraft.start import state_at_start
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.controllers import SampledController, controller_names, make_controller
from ffsm_drake.systems.controllers.law import is_shipped
from ffsm_drake.systems.disturbance import sines_of
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_frame_motion, make_motion, prescribes_frame
from ffsm_drake.systems.registry import Factory, call_factory, section_parts
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.sensing.block import measurement_of
from ffsm_drake.systems.sensing.errors import SensorErrors
from ffsm_drake.systems.setup import BlockSetup

_KEPT = 64  # cases
_DETECTION = "sensing.detection"


# Sections on which code depends only through blocks and the controller's name, see ``Run.key``.
_FREE = (
    "controller",
    "controllers",
    "description",
    "random_seed",
    "divergence_speed",
    "tolerance",
    "clearance",
    "planning",
    "initial_posture",
    "initial_velocity",
    "target_posture",
    "disturbance",
    "payload",
    "capture",
)
_PHASES = "phases."


class Case:
    """What runs share that differ at most in their controllers."""

    def __init__(
        self,
        scenario: Scenario,
        grip: Grip = HELD,
        *,
        further: int = 0,
        first: int = 0,
        last: int | None = None,
        motion: PlannedMotion | None = None,
        blocks: Mapping[str, Factory] = {},
        joint_force: np.ndarray | None = None,
        noise: Noise | None = None,
    ) -> None:
        """Args:
        scenario: the scenario.
        grip: what holds the target.
        further: samples after its end of which rows are known.
        first: sample of the run at which a phase begins.
        last: the sample after it; None: it lasts to the end.
        motion: of the phase; None: from the scenario.
        blocks: factories of blocks in place of the scenario's.
        joint_force: see ``add_closed_loop``.
        noise: of the run, if it is known.
        """
        self.scenario, self._further, self._given = scenario, further, blocks
        self._given_motion, self._given_noise = motion, noise
        self.true = make_flexible_plant(scenario, grip)
        self.nominal = make_nominal_plant(scenario, grip)
        self.coordinates: Coordinates = self.nominal.coordinates
        self._settled = settle_faults(scenario, self.coordinates)
        self.samples = scenario.num_control_periods + 1 + further
        self.window = slice(first, self.samples if last is None else last + 1)
        self._gains_are_checked = False
        self._runs = dict[str, Run]()
        self.built = set[str]()  # names of blocks, see ``_built``
        self._shown = list[str]()  # outputs of these
        self.shown = dict[str, np.ndarray]()  # signals of a reference (samples, n), see ``follow``
        own = reader_of(self.true.plant)
        errors = SensorErrors(scenario.sensing, self.coordinates, scenario.sample_time)
        self._drift = drift = errors.drift()
        stages = measurement_of(errors), *self._built("sensing").values()
        self.detector = None if stages[-1].traced else stages[-1]
        built = self._built("forces")
        self.reference = self._reference()
        self.supervisor = self._supervisor()
        self.watch = None if self.supervisor is None else self.supervisor.block
        actuators, flows = self._acting()
        self.parts = _frozen(
            {
                "sensing": _numbered(each for each in stages if each.traced),
                "actuation": _numbered(actuators),
                "flows": _numbered(flows),
                "forces": {name: each for name, each in built.items() if isinstance(each, Sampled)},
                "last": {
                    name: each for name, each in built.items() if isinstance(each, Continuous)
                },
                "supervisor": {} if self.watch is None else {"supervisor": self.watch},
            }
        )
        found = parameters_of(self.parts, "blocks")
        phases = tuple(len(block.phase(0)) for _, block in sampled_of(self.parts))
        self.constants = found.constants, tuple(built), phases
        disturbance, force = sines_of(scenario.disturbance, self.coordinates), scenario.actuation
        limit = self.coordinates.vector(force.limit or {}, key="actuation.limit", default=np.inf)
        resolution = self.coordinates.vector(
            force.quantization, key="actuation.quantization", default=0.0
        )
        config = scenario.simulator_config
        parts = max((each.per_sample for each in self.parts["forces"].values()), default=1) or 1
        self.steps = steps_of(scenario.sample_time, config.max_step_size, parts)
        if not self.steps:
            raise NotCovered("steps that do not divide a sample")
        self.parameters = {
            "own": own.parameters(self.true.context),
            "parts": found.values,
            "deviation": errors.deviation,
            "limit": limit,
            "force_resolution": resolution,
            "sines": disturbance.ravel(),
            "share": drift.kept,
            "added": drift.added,
            "sample_time": np.array([scenario.sample_time]),
            "step": np.array([scenario.sample_time / self.steps]),
            "bound": np.array([scenario.divergence_speed]),
            "joint_force": np.zeros(0) if joint_force is None else joint_force,
        }
        self._sizes_of_noise = {"size": errors.bias.size, "drifting": drift.kept.size}
        known = self.true.split.known_part(np.arange(self.true.plant.num_multibody_states()))
        self.fixed: dict[str, Any] = {
            "tree": own.tree,
            "known": tuple(known.tolist()),
            "hidden": tuple(self.true.split.hidden_state.tolist()),
            "forced": tuple(
                self.true.split.known_velocities(np.arange(own.tree.num_velocities)).tolist()
            ),
            "loose": tuple(self.true.split.hidden.tolist()),
            "coordinates": self.coordinates,
            "recorded": self._recorded(),
            "num_numbers": found.values.size,
            "noisy": bool(errors.deviation.any()),
            "num_drifts": drift.kept.size,
            "framed": prescribes_frame(scenario),
            "limited": bool(np.isfinite(limit).any()),
            "quantized": bool(resolution.any()),
            "waits": force.delay,
            "limp": joint_force is not None,
            "scheme": config.integration_scheme,
        }

    @functools.cached_property
    def states(self) -> dict[str, np.ndarray]:
        """What a run begins with but the memory of its law, by the names of ``Blocks.states``."""
        return self.states_at(state_at_start(self.scenario, self.true))

    def states_at(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """``states`` at the plant's own [q; v]."""
        known = state[list(self.fixed["known"])]
        flowing = [each.start(known) for each in self.parts["flows"].values()]
        return {
            "x": row([state, *(value for of in flowing for value in of.values())]),
            "drift": self._drift_at_start(),
            **kept_at(self.parts, known),
        }

    def carrying(self, payload: MassProperties) -> "Case":
        """The same with other true mass properties of the payload."""

        def loaded(block: Any) -> Any:
            return block.with_payload(payload) if hasattr(block, "with_payload") else block

        other = copy.copy(self)
        other.true = Carrier(self.scenario).loaded(self.true, payload)
        other.parts = _frozen(
            {
                kind: {name: loaded(each) for name, each in of.items()}
                for kind, of in self.parts.items()
            }
        )
        own = reader_of(self.true.plant).parameters(other.true.context)
        found = parameters_of(other.parts, "blocks").values
        other.parameters = self.parameters | {"own": own, "parts": found}
        return other

    def _drift_at_start(self) -> np.ndarray:
        start = self._drift.start
        return start * self.noise.start if start.any() else start

    def with_seed(self, seed: int) -> "Case":
        """The same with another seed."""
        scenario = dataclasses.replace(self.scenario, random_seed=seed)
        if scenario.faults is not None:
            return Case(scenario, self.nominal.grip, further=self._further)
        other = copy.copy(self)
        other.scenario = scenario
        vars(other).pop("noise", None)
        other.states = self.states | {"drift": other._drift_at_start()}
        return other

    def _acting(self) -> tuple[tuple[Sampled, ...], tuple[Continuous, ...]]:
        """The actuators after limits, quantisation and delay, and the flows beside them."""
        make = optional(SERVICES, "acting_blocks")
        row, beside = ((), ()) if make is None else make(self._settled, self.coordinates)
        return tuple(row), tuple(beside)

    def _supervisor(self) -> Any:
        """The supervisor, with a ``block``; None: there is none."""
        own = section_parts(self._settled).get("supervisor")
        part: Any = self._given.get("supervisor", own)
        return None if part is None else part.supervisor(self._setup("supervisor", {}))

    def _reference(self) -> Any:
        """A reference of blocks without inputs; None: the motion. Raises NotCovered."""
        factory = self._given.get("reference")
        if factory is None:
            return None
        setup = self._setup("reference", {})
        made = call_factory(factory, setup, place="blocks.reference")
        if not isinstance(made, Sampled) or made.inputs:
            raise NotCovered("blocks.reference")
        signals = factory.signals(setup) if isinstance(factory, Part) else ()
        self._held = {signal.name: signal.held for signal in signals}
        self.built.add("reference")
        return made

    def follow(self, memory: Arrays) -> Arrays:
        """Compute the reference over the phase, from its memory at the begin. Return its memory
        before the last sample.
        """
        period, samples = self.scenario.sample_time, range(self.window.start, self.window.stop)
        found, memories = list[Arrays](), [memory]
        for sample in (*samples, samples[-1]):  # again, to see what comes after it
            outputs, memory = self.reference.step({}, memory, Now(period * sample))
            found.append(outputs)
            memories.append(memory)
        rows = {name: np.array([each[name] for each in found]) for name in found[0]}
        self._followed = {name: values[:-1] for name, values in rows.items()}
        for name, is_held in self._held.items():
            self.shown[name] = np.zeros((self.samples, rows[name].shape[1]))
            self.shown[name][self.window] = rows[name][1:] if is_held else rows[name][:-1]
        vars(self).pop("planned", None)
        return memories[-3]

    def detectors(self) -> list[tuple[Sampled, Arrays]]:
        """The detector, with its memory at the start; none without it."""
        if self.detector is None:
            return []
        known = self.states["x"][list(self.fixed["known"])]
        return [(self.detector, self.detector.start(known))]

    def _recorded(self) -> tuple[str, ...]:
        """Signals of actuators and forces."""
        setup = self._setup("actuation", {})
        parts = section_parts(self.scenario, of="actuation").values()
        names = [signal.name for part in parts for signal in part.signals(setup)]
        return *names, *self._shown

    def _setup(self, name: str, settings: Mapping[str, Any]) -> BlockSetup:
        return BlockSetup(
            name=name,
            scenario=self._settled,
            nominal=self.nominal,
            settings=settings,
            split=self.true.split,
        )

    def _built(self, kind: str) -> dict[str, Any]:
        """The blocks of a kind in addition to the first one, by name. Raises NotCovered: one is a
        Drake system.
        """
        scenario, found = self._settled, dict[str, Any]()
        choices = scenario.blocks.choices()
        parts = section_parts(scenario, grip=self.nominal.grip)
        for block in dict.fromkeys((*parts, *choices, *self._given)):
            first, _, name = block.partition(".")
            if first != kind or not name or block == DISTURBANCE:
                continue
            choice = choices.get(block, Block())
            given = self._given.get(block) or parts.get(block)
            factory = given or factory_of(block, scenario)
            setup, place = self._setup(name, choice.settings), f"blocks.{block} '{choice.system}'"
            part: Any = factory  # whose ``flow`` has pure functions in place of a Drake system
            made = call_factory(getattr(part, "flow", part), setup, place=place)
            if isinstance(factory, Part) and kind == "forces":
                self._shown += [each.name for each in factory.signals(setup)]
                self._shown += factory.logged
            is_last = kind == "forces" and isinstance(made, Continuous) and not made.start()
            if not (isinstance(made, Sampled) or is_last):
                raise NotCovered(block)
            if isinstance(made, Sampled) and not made.traced and block != _DETECTION:
                raise NotCovered(f"{block}, which is not traced")
            found[name] = made
            self.built.add(block)
        return found

    def run(self, scenario: Scenario) -> "Run":
        """The run with the scenario's controller; one with a law of this package is kept. Raises
        what ``Run`` raises.
        """
        name = scenario.controller
        if name in self._runs:
            return self._runs[name]
        made = Run(scenario, self)
        if is_shipped(made.law):
            self._runs[name] = made
        return made

    def forget_rows(self) -> None:
        """Free what runs read, which needs the most memory."""
        for name in ("planned", "noise"):
            vars(self).pop(name, None)

    def controller_of(self, scenario: Scenario) -> System:
        """The controller of a run. Those after the first need no check of the gains of others,
        which are the same.
        """
        name = scenario.controller
        if not (is_known := name in controller_names()) or not self._gains_are_checked:
            made = make_controller(scenario, self.nominal)
            self._gains_are_checked |= is_known
            return made
        given = copy.copy(scenario)
        given.controllers = {key: own for key, own in given.controllers.items() if key == name}
        return make_controller(given, self.nominal)

    @functools.cached_property
    def kind(self) -> str:
        """Equal for scenarios that differ in their controllers, in numbers other than zero, and in
        the sections ``_FREE``.
        """
        neutral = Scenario()
        free = {name: getattr(neutral, name) for name in _FREE}
        data = scenario_to_dict(dataclasses.replace(self.scenario, **free))
        exact = {name: data[name] for name in ("sample_time", "simulator_config")}
        return json.dumps(_kind(data) | exact, sort_keys=True)

    @functools.cached_property
    def noise(self) -> Noise:
        """The samples of its sensors' noise."""
        seed = self.scenario.random_seed
        return self._given_noise or noise_of(seed, self.samples, **self._sizes_of_noise)

    @functools.cached_property
    def motion(self) -> PlannedMotion:
        """The reference."""
        return self._given_motion or make_motion(self.scenario, self.coordinates, self.nominal.grip)

    @functools.cached_property
    def times(self) -> np.ndarray:
        """The control samples (samples), s."""
        return self.scenario.sample_time * np.arange(self.samples)

    @functools.cached_property
    def planned(self) -> dict[str, np.ndarray]:
        """What runs read at each sample, without noise (samples, n), by the names of
        ``Blocks.row``; 0 before and after a phase.
        """
        watch, times = self.parts["supervisor"], self.times[self.window]
        made = {
            "reference": self.motion.rows(times),
            "phases": phases_at(self.parts, self.samples)[self.window],
            "request": np.zeros((len(times), len(watch))),
        }
        if self.reference is not None:
            plan = [self._followed[name] for name in ("desired_state", "desired_acceleration")]
            made["reference"] = np.hstack(plan)
            if watch and "abort_request" in self._followed:
                made["request"] = self._followed["abort_request"]
        if (path := make_frame_motion(self.scenario, self.nominal, self.motion)) is not None:
            made["frame"] = path.rows(times)
        found = {name: np.zeros((self.samples, values.shape[1])) for name, values in made.items()}
        for name, values in made.items():
            found[name][self.window] = values
        return found

    @property
    def rows(self) -> dict[str, np.ndarray]:
        """What runs read at each sample (samples, n), by the names of ``Blocks.row``."""
        return self.planned | {"noise": self.noise.white, "drift_noise": self.noise.drift}


class Run:
    """One run: what its code depends on, and its numbers."""

    def __init__(
        self, scenario: Scenario, case: Case | None = None, law: Factory | None = None
    ) -> None:
        """Args: the scenario, what it shares with other runs, and the factory of another law."""
        self.scenario, self.case = scenario, Case(scenario) if case is None else case
        # blocks in place of the scenario's
        self.given: dict[str, Factory] = {} if law is None else {"controller": law}
        controller = (
            self.case.controller_of(scenario)
            if law is None
            else make_controller(scenario, self.case.nominal, law)
        )
        if not isinstance(controller, SampledController):
            raise NotCovered("a controller that is a Drake system")
        self.controller, self.law = controller, controller.law
        if getattr(self.law, "contacts_read", 0) and not self.case.parts["last"]:
            raise NotCovered("a law that reads contacts")
        self.coordinates, self.samples = self.case.coordinates, self.case.samples
        self.motion, self.steps = self.case.motion, self.case.steps
        self._first_memory = row(self.law.initial_state().values())
        try:
            found = parameters_of(self.law)
        except NotCovered as error:
            self._call_law(error.what)
        else:
            self._lay_out(*found)
            if self.case.detector is not None:
                self._call_law("fault detection")
        self.key = (self.case.kind, scenario.controller, type(self.law), *self.code)

    def _lay_out(self, law: np.ndarray, constants: Any, planned: int, *, called: str = "") -> None:
        """Args: of the law: its parameters, constants, and planned numbers; see ``Blocks``."""
        at_start = self._first_memory if self.case.watch is not None else np.zeros(0)
        fixed: dict[str, Any] = {
            "num_parameters": law.size,
            "num_planned": planned,
            **self.case.fixed,
        }
        self.parameters = self.case.parameters | {"law": law, "law_at_start": at_start}
        self.blocks = Blocks(
            law=self.law,
            parts=self.case.parts,
            detector=self.case.detector,
            called=called,
            **fixed,
        )
        self.code = (*fixed.values(), self.case.constants, constants, self.steps)  # if it is equal

    @functools.cached_property
    def states(self) -> dict[str, np.ndarray]:
        """What it begins with, by the names of ``Blocks.states``."""
        return self.case.states | {"memory": self._first_memory}

    def carrying(self, payload: MassProperties) -> "Run":
        """See Case."""
        other = copy.copy(self)
        other.case = self.case.carrying(payload)
        other.parameters = self.parameters | other.case.parameters
        return other

    def _call_law(self, why: str) -> None:
        self._lay_out(np.zeros(0), (), 0, called=why)
        layout = {name: value.size for name, value in self.blocks.memory.items()}
        ports = self.blocks.law_inputs, self.blocks.detector_inputs, self.blocks.detector_outputs
        self.code = (*self.code, "called", str(layout), str(ports))

    def with_called_law(self, why: str) -> "Run":
        """Return the run with its law called. Args: why the law is not traced."""
        if self.blocks.called:
            return self
        other = copy.copy(self)
        other._call_law(why)
        return other

    @property
    def rows(self) -> dict[str, np.ndarray]:
        """What it reads at each sample (samples, n), by the names of ``Blocks.row``."""
        if not self.blocks.num_planned:
            return self.case.rows
        until = self.case.window.stop
        planned = rows_of(self.law, self.case.planned["reference"][:until, : self.blocks.nq])
        return self.case.rows | {"planned": planned}

    @property
    def key_on_disk(self) -> str | None:
        """What the code is made from, besides this package; None for a user's law or block."""
        own = self.blocks.called or is_shipped(self.law)
        own = own and all(name.startswith(_PHASES) for name in self.scenario.blocks.choices())
        return repr(self.code) if own else None


def _frozen(parts: Parts) -> Parts:
    return MappingProxyType({kind: MappingProxyType({**of}) for kind, of in parts.items()})


def _numbered(blocks: Iterable[Any]) -> dict[str, Any]:
    return {str(index): each for index, each in enumerate(blocks)}


_cases: collections.OrderedDict[Any, tuple[Scenario, Case]] = collections.OrderedDict()


def case_of(scenario: Scenario, grip: Grip = HELD) -> Case:
    """Return what phases share whose scenarios differ in their controllers at most. The last ones
    without blocks of a user are kept, for the predictions of their runs.
    """
    if scenario.blocks.choices():
        return Case(scenario, grip)
    shared = dataclasses.replace(scenario, controller="")
    key = grip, scenario.random_seed, content_of(files_read(scenario))
    if key not in _cases or _cases[key][0] != shared:
        _cases[key] = shared, Case(scenario, grip)
        if len(_cases) > _KEPT:
            _cases.popitem(last=False)
    return _cases[key][1]


def _kind(data: Any) -> Any:
    """Plain data without the values of its numbers other than zero; those by coordinate, and of
    vectors, as one.
    """
    entries = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    if entries and all(isinstance(each, float) for each in entries):
        return any(entries)
    if isinstance(data, dict):
        return {name: _kind(value) for name, value in data.items()}
    if isinstance(data, list):
        return [_kind(value) for value in data]
    return bool(data) if isinstance(data, float) else data
