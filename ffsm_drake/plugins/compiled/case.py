"""What runs share that differ at most in their controllers."""

import copy
import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import System

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.blocks import Structure
from ffsm_drake.plugins.compiled.kinds import kind_of
from ffsm_drake.plugins.compiled.noise import Noise, noise_of
from ffsm_drake.plugins.compiled.parameters import parameters_of, reader_of
from ffsm_drake.plugins.compiled.parts import (
    Block,
    Parts,
    frozen,
    kept_at,
    phases_at,
    row,
    sampled_of,
)
from ffsm_drake.plugins.compiled.recent import Recent
from ffsm_drake.plugins.compiled.scenario_blocks import ActingBlocks, ScenarioBlocks
from ffsm_drake.plugins.compiled.schemes import steps_of
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import HELD, Grip, MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.controllers import controller_names, make_controller
from ffsm_drake.systems.disturbance import sines_of
from ffsm_drake.systems.faults import settle_faults
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_frame_motion, make_motion, prescribes_frame
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.sensing.errors import SensorErrors
from ffsm_drake.systems.setup import BlockSetup
from ffsm_drake.systems.start import state_at_start

_KEPT = 64  # cases


class Case:
    """What runs share that differ at most in their controllers."""

    def __init__(
        self,
        mission: Mission,
        grip: Grip = HELD,
        *,
        further: int = 0,
        first: int = 0,
        last: int | None = None,
        motion: PlannedMotion | None = None,
        blocks: Mapping[str, Factory] = {},
        joint_force: np.ndarray | None = None,
        noise: Noise | None = None,
        acting: ActingBlocks | None = None,
    ) -> None:
        """Args:
        mission: the mission.
        grip: what holds the target.
        further: samples after its end of which rows are known.
        first: sample of the run at which a phase begins.
        last: the sample after it; None: it lasts to the end.
        motion: of the phase; None: of the mission.
        blocks: factories of blocks in place of the scenario's.
        joint_force: see ``add_closed_loop``.
        noise: of the run, if it is known.
        acting: makes the actuators in place of the scenario's.

        Raises NotCovered.
        """
        self.mission, self._further = mission, further
        self.scenario = scenario = mission.scenario
        self._given_motion, self._given_noise = motion, noise
        self.true, self.nominal = mission.craft.flexible(grip), mission.craft.nominal(grip)
        self.coordinates: Coordinates = self.nominal.coordinates
        self.samples = scenario.num_control_periods + 1 + further
        self.window = slice(first, self.samples if last is None else last + 1)
        self._gains_are_checked = False
        self.runs = dict[str, object]()  # those with a law of this package, by controller
        self._errors = SensorErrors(scenario.sensing, self.coordinates, scenario.sample_time)
        self._drift = self._errors.drift()
        settled = mission.of(settle_faults(scenario, self.coordinates))
        plain = BlockSetup(name="", mission=settled, nominal=self.nominal, settings={})
        reader_of(self.true)  # refuses an unknown joint before a block is made
        self.made = ScenarioBlocks(plain, self._errors, blocks, acting)
        self.parts = self.made.parts
        found = parameters_of(self.parts, "blocks")
        phases = tuple(len(block.phase(0)) for _, block in sampled_of(self.parts))
        self.constants = found.constants, self.made.external, phases
        config = scenario.simulator_config
        parts = max((each.per_sample for each in self.parts.forces.values()), default=1) or 1
        self.steps = steps_of(scenario.sample_time, config.max_step_size, parts)
        if not self.steps:
            raise NotCovered("steps that do not divide a sample")
        self.parameters = self._numbers(found.values, joint_force)
        self.fixed = self._structure(found.values.size, is_limp=joint_force is not None)

    def _numbers(self, parts: np.ndarray, joint_force: np.ndarray | None) -> dict[str, np.ndarray]:
        """Numbers of a run but those of its law, by the names of ``Blocks.parameters``."""
        scenario, force = self.scenario, self.scenario.actuation
        vector = self.coordinates.vector
        return {
            "own": reader_of(self.true).parameters(self.true.context),
            "parts": parts,
            "deviation": self._errors.deviation,
            "limit": vector(force.limit or {}, key="actuation.limit", default=np.inf),
            "force_resolution": vector(
                force.quantization, key="actuation.quantization", default=0.0
            ),
            "sines": sines_of(scenario.disturbance, self.coordinates).ravel(),
            "share": self._drift.kept,
            "added": self._drift.added,
            "sample_time": np.array([scenario.sample_time]),
            "step": np.array([scenario.sample_time / self.steps]),
            "bound": np.array([scenario.divergence_speed]),
            "joint_force": np.zeros(0) if joint_force is None else joint_force,
        }

    def _structure(self, num_numbers: int, *, is_limp: bool) -> Structure:
        """What its code depends on but parts and law, by the names of ``Blocks``."""
        split, tree = self.true.split, reader_of(self.true).tree
        known = split.known_part(np.arange(self.true.plant.num_multibody_states()))
        forced = split.known_velocities(np.arange(tree.num_velocities))
        return Structure(
            tree=tree,
            known=tuple(known.tolist()),
            hidden=tuple(split.hidden_state.tolist()),
            forced=tuple(forced.tolist()),
            loose=tuple(split.hidden.tolist()),
            coordinates=self.coordinates,
            recorded=self.made.recorded(self.scenario),
            num_numbers=num_numbers,
            noisy=bool(self._errors.deviation.any()),
            num_drifts=self._drift.kept.size,
            framed=prescribes_frame(self.scenario),
            limited=bool(np.isfinite(self.parameters["limit"]).any()),
            quantized=bool(self.parameters["force_resolution"].any()),
            waits=self.scenario.actuation.delay,
            limp=is_limp,
            hands=len(self.scenario.contacts) > 1,
            scheme=self.scenario.simulator_config.integration_scheme,
        )

    @functools.cached_property
    def states(self) -> dict[str, np.ndarray]:
        """What a run begins with but the memory of its law, by the names of ``Blocks.states``."""
        return self.states_at(state_at_start(self.mission, self.true))

    def states_at(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """``states`` at the plant's own [q; v]."""
        known = state[list(self.fixed.known)]
        flowing = [each.start(known) for each in self.parts.flows.values()]
        return {
            "x": row([state, *(value for of in flowing for value in of.values())]),
            "drift": self._drift_at_start(),
            **kept_at(self.parts, known),
        }

    def carrying(self, payload: MassProperties) -> "Case":
        """The same with other true mass properties of the payload."""

        def loaded(blocks: Mapping[str, Block]) -> Mapping[str, Block]:
            return frozen(
                {
                    name: each.with_payload(payload) if hasattr(each, "with_payload") else each
                    for name, each in blocks.items()
                }
            )

        other = copy.copy(self)
        other.true = self.mission.craft.loaded(self.true, payload)
        of = self.parts
        other.parts = Parts(
            sensing=loaded(of.sensing),
            actuation=loaded(of.actuation),
            flows=loaded(of.flows),
            forces=loaded(of.forces),
            last=loaded(of.last),
            supervisor=loaded(of.supervisor),
        )
        own = reader_of(self.true).parameters(other.true.context)
        found = parameters_of(other.parts, "blocks").values
        other.parameters = self.parameters | {"own": own, "parts": found}
        return other

    def exchanging(self, name: str, block: Continuous) -> "Case":
        """The same with another last force."""
        other = copy.copy(self)
        other.parts = self.parts._replace(last=frozen({**self.parts.last, name: block}))
        found = parameters_of(other.parts, "blocks").values
        other.parameters = self.parameters | {"parts": found}
        return other

    def _drift_at_start(self) -> np.ndarray:
        start = self._drift.start
        return start * self.noise.start if start.any() else start

    def with_seed(self, seed: int) -> "Case":
        """The same with another seed."""
        mission = self.mission.flown_by(random_seed=seed)
        drawn = mission.scenario.faults, *vars(mission.scenario.effects).values()
        if any(each is not None for each in drawn):
            return Case(mission, self.nominal.grip, further=self._further)
        other = copy.copy(self)
        other.mission, other.scenario = mission, mission.scenario
        vars(other).pop("noise", None)
        other.states = self.states | {"drift": other._drift_at_start()}
        return other

    def follow(self, memory: Arrays) -> Arrays:
        """Compute a reference that is a block over the phase, from its memory at the begin. Return
        its memory before the last sample.
        """
        if self.made.reference is None:
            return memory
        samples = range(self.window.start, self.window.stop)
        vars(self).pop("planned", None)
        return self.made.reference.follow(memory, samples, self.scenario.sample_time)

    @property
    def shown(self) -> dict[str, np.ndarray]:
        """Signals of a reference that is a block (samples, n)."""
        return {} if self.made.reference is None else self._whole(self.made.reference.shown)

    def forget_rows(self) -> None:
        """Free what runs read, which needs the most memory."""
        for name in ("planned", "noise"):
            vars(self).pop(name, None)

    def controller_of(self, mission: Mission) -> System:
        """The controller of a run. Those after the first need no check of the gains of others,
        which are the same.
        """
        scenario = mission.scenario
        name = scenario.controller
        if not (is_known := name in controller_names()) or not self._gains_are_checked:
            made = make_controller(mission, self.nominal)
            self._gains_are_checked |= is_known
            return made
        own = {key: given for key, given in scenario.controllers.items() if key == name}
        return make_controller(mission.flown_by(controllers=own), self.nominal)

    @functools.cached_property
    def kind(self) -> str:
        """See ``kind_of``."""
        return kind_of(self.scenario)

    @functools.cached_property
    def noise(self) -> Noise:
        """The samples of its sensors' noise."""
        sizes = {"size": self._errors.bias.size, "drifting": self._drift.kept.size}
        return self._given_noise or noise_of(self.scenario.random_seed, self.samples, **sizes)

    @functools.cached_property
    def motion(self) -> PlannedMotion:
        """The reference."""
        return self._given_motion or make_motion(self.mission, self.nominal.grip)

    @functools.cached_property
    def times(self) -> np.ndarray:
        """The control samples (samples), s."""
        return self.scenario.sample_time * np.arange(self.samples)

    @functools.cached_property
    def planned(self) -> dict[str, np.ndarray]:
        """What runs read at each sample, without noise (samples, n), by the names of
        ``Blocks.row``; 0 before and after a phase.
        """
        watches, times = self.made.watch is not None, self.times[self.window]
        made = {
            "reference": self.motion.rows(times),
            "phases": phases_at(self.parts, self.samples)[self.window],
            "request": np.zeros((len(times), int(watches))),
        }
        if (path := make_frame_motion(self.mission, self.nominal, self.motion)) is not None:
            made["frame"] = path.rows(times)
        if self.made.reference is not None:
            followed = self.made.reference.rows
            plan = [followed[name] for name in ("desired_state", "desired_acceleration")]
            made["reference"] = np.hstack(plan)
            if watches and "abort_request" in followed:
                made["request"] = followed["abort_request"]
            if "desired_frame" in followed:
                made["frame"] = followed["desired_frame"]
        return self._whole(made)

    def _whole(self, of_phase: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Rows of a phase among those of the whole run; 0 before and after it."""
        found = {name: np.zeros((self.samples, v.shape[1])) for name, v in of_phase.items()}
        for name, values in of_phase.items():
            found[name][self.window] = values
        return found

    @property
    def rows(self) -> dict[str, np.ndarray]:
        """What runs read at each sample (samples, n), by the names of ``Blocks.row``."""
        return self.planned | {"noise": self.noise.white, "drift_noise": self.noise.drift}


_cases = Recent[tuple[Scenario, Case]](_KEPT)


def case_of(mission: Mission, grip: Grip = HELD, acting: ActingBlocks | None = None) -> Case:
    """Return what phases share whose missions differ in their controllers at most. The last ones
    without blocks of a user are kept, for the predictions of their runs. Args: see ``Case``.
    """
    scenario = mission.scenario
    if scenario.blocks.choices():
        return Case(mission, grip, acting=acting)
    key, shared = (grip, scenario.random_seed, acting), dataclasses.replace(scenario, controller="")
    known, case = _cases.get(key) or (None, None)
    if case is None or known != shared or case.mission.plan is not mission.plan:
        case = Case(mission, grip, acting=acting)
        _cases.keep(key, (shared, case))
    return case
