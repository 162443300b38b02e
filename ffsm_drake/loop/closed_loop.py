"""The closed loop: the blocks and the plant, wired into one Diagram.

               +------------+                                     forces (summed)
    reference->|            |  commanded  +-----------+  applied    |
               | controller |------------>| actuation |----------->(+)--> plant --+--> state
     estimated>|            |    force    +-----------+   force                   |
               +------------+                                                     |
         ^---------------------------- sensing <----------------------------------+

``loop.blocks`` defines each block's ports and the systems that fill it.
"""

import dataclasses
import functools
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Gain,
    MatrixGain,
    ZeroOrderHold,
)

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.guard import calling, guarded, is_user_supplied
from ffsm_drake.loop.blocks import (
    ABORT,
    ADDED_FORCES,
    BLOCKS,
    ISOLATED,
    JAM,
    READ_BY_FORCES,
    REPORTED_FORCES,
    REPORTED_UNITS,
    TOLD,
    WRENCH,
    make_blocks,
)
from ffsm_drake.mission import Mission, OfMission, make_mission
from ffsm_drake.scenario import HELD, Grip, MassProperties, Scenario, kind_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers.controller import SampledController
from ffsm_drake.systems.parts.placed import Parts
from ffsm_drake.systems.parts.signals import EFFORT, Signal
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.sampled import NEXT
from ffsm_drake.systems.selection import make_selector
from ffsm_drake.systems.start import state_at_start

# Variables of the record.
_force = functools.partial(Signal, unit=EFFORT, dimension="coordinate")
FORCES = (
    _force(name="generalized_force", meaning="control tau, held from this sample to the next"),
    _force(name="applied_force", meaning="force applied by the actuators, held from this sample "
                                         "to the next"),
    _force(
        name="disturbance_force", held=False,
        meaning="external forces tau_d at this instant, summed",
    ),
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClosedLoop(OfMission):
    """The plant and the connected blocks of a closed loop.

    Example:
      >>> from ffsm_drake import load_scenario, make_closed_loop
      >>> loop = make_closed_loop(load_scenario("postcapture"))
      >>> list(loop.blocks)
      ['reference', 'sensing', 'controller', 'forces.disturbance']
      >>> loop.diagram.num_input_ports()
      0
    """

    plant: MultibodyPlant  # the true one, with hidden coordinates
    # "reference", "sensing", "controller", "forces.disturbance", other forces; "actuation" unless
    # it is ideal
    blocks: Mapping[str, System]
    # Signal -> the system and the name of its output port. Every loop has state, estimated_state,
    # measurement, desired_state, desired_acceleration, generalized_force, applied_force and
    # disturbance_force. Further signals: the controller's OPTIONAL_OUTPUTS, those of parts,
    # "hidden_state" with hidden coordinates, "force_<name>" for each of several external forces.
    sources: Mapping[str, tuple[System, str]]
    parts: Parts = dataclasses.field(default_factory=dict)  # parts among ``blocks``
    grip: Grip = HELD  # what holds the target
    joint_force: np.ndarray | None = None  # see ``add_closed_loop``
    diagram: Any = None  # the Diagram, after ``make_closed_loop``; its outputs are the signals

    @property
    def tracks_frame(self) -> bool:
        """True if the controller tracks a frame's pose, and coordinates only in its null space."""
        return bool(self.blocks["controller"].HasInputPort("desired_frame"))

    def output_port(self, signal: str) -> OutputPort:
        """Return the port of a signal of ``sources``; ``disturbance_force`` sums the external
        forces.
        """
        system, name = self.sources[signal]
        return system.GetOutputPort(name)

    def initialize(self, root: System, root_context: Context) -> None:
        """Seed the noise, set the payload, and set the initial posture and velocity.

        Args:
          root: the diagram that holds the loop.
          root_context: a context of ``root``.
        """
        scenario = self.scenario
        # First: it resets every state and parameter of the diagram.
        root.SetRandomContext(root_context, RandomGenerator(scenario.random_seed))
        context = self.plant.GetMyMutableContextFromRoot(root_context)
        self.mission.craft.set_true_masses(self.plant, context, self.grip)
        for placed in self.parts.values():
            placed.part.check_plant(scenario, self.model(context))
        self._tell("set_payload", root_context, self.grip.carried(scenario.payload).truth)
        self.set_whole_state(root_context, state_at_start(self.mission, self.model(context)))

    def model(self, plant_context: Context) -> PlantModel:
        """Return the plant in one of its contexts, for computations."""
        return PlantModel(
            plant=self.plant,
            context=plant_context,
            coordinates=self.coordinates,
            split=self.split,
            grip=self.grip,
        )

    def set_payload(self, root_context: Context, properties: MassProperties) -> None:
        """Set the payload's true mass properties in the plant and in the blocks that use them."""
        context = self.plant.GetMyMutableContextFromRoot(root_context)
        self.mission.craft.change_payload(self.plant, context, properties)
        self._tell("set_payload", root_context, properties)

    def set_state(self, root_context: Context, state: np.ndarray) -> None:
        """Set the plant to a known state [q; v], and reset the blocks, without history, to it."""
        self.set_whole_state(root_context, self.split.whole(state))

    def set_whole_state(self, root_context: Context, state: np.ndarray) -> None:
        """Set the plant's own [q; v] (nq + nv), with the hidden state. See ``set_state``."""
        self.plant.SetPositionsAndVelocities(
            self.plant.GetMyMutableContextFromRoot(root_context), state
        )
        self.set_blocks(root_context, self.split.known_part(state))

    def whole_state(self, root_context: Context) -> np.ndarray:
        """Return the plant's own [q; v] (nq + nv)."""
        context = self.plant.GetMyContextFromRoot(root_context)
        return self.plant.GetPositionsAndVelocities(context)

    def set_blocks(self, root_context: Context, state: np.ndarray) -> None:
        """Reset the blocks, without history, to a known state [q; v]."""
        self._tell("set_initial_state", root_context, state)

    def _tell(self, method: str, root_context: Context, what: Any) -> None:
        """Call a method of the blocks that have it."""
        for name, block in self.blocks.items():
            function = getattr(block, method, None)
            if function is None:
                continue
            context = block.GetMyMutableContextFromRoot(root_context)
            if is_user_supplied(type(block)):
                place = f"blocks.{name} '{type(block).__name__}'"
                calling(f"{place}: {method}", function, context, what)
            else:
                function(context, what)

    def resume(
        self,
        root_context: Context,
        before: "ClosedLoop",
        context_before: Context,
        reference: np.ndarray | None = None,
        *,
        afresh: Collection[str] = (),
    ) -> None:
        """Continue with the states of the blocks of another loop that has the same wiring.

        Args:
          root_context: root context of this loop.
          before: the other loop.
          context_before: root context of the other loop.
          reference: [q_d; v_d] (nq + nv) at the start of this loop's motion, if the nominal model
            changes; None: it does not change.
          afresh: blocks that start anew. A controller among them keeps the force that acts.
        """
        for name, block in self.blocks.items():
            if name not in before.blocks:
                continue
            other, context = before.blocks[name], block.GetMyMutableContextFromRoot(root_context)
            then, is_afresh = other.GetMyContextFromRoot(context_before), name in afresh
            if isinstance(block, SampledController) and is_afresh:
                force = other.state(then, "generalized_force")
                if before.joint_force is not None:
                    force[NUM_BASE_VELOCITIES:] = before.joint_force
                block.begin(context, force)
            elif isinstance(block, SampledController) and reference is not None:
                block.resume(context, other, then, reference)
            elif not is_afresh:
                context.SetStateAndParametersFrom(then)


@guarded
def add_closed_loop(
    builder: DiagramBuilder,
    scenario: Scenario | Mission,
    *,
    blocks: Mapping[str, Factory] | None = None,
    plant: MultibodyPlant | None = None,
    joint_force: np.ndarray | None = None,
    grip: Grip = HELD,
) -> ClosedLoop:
    """Add the closed loop of a scenario to a Drake diagram.

    Args:
      builder: the builder of the diagram.
      scenario: the scenario to build, or its mission.
      blocks: block -> factory (BlockSetup -> Drake system), which replaces a block of the scenario,
        such as ``{"sensing": Vicon, "forces.friction": Friction}``; see ``loop.blocks``.
      plant: a plant that is already in the diagram (``add_combined_plant``, for display); default:
        a new plant without geometry.
      joint_force: (joints), constant force of the joint actuators, which replaces the command, N m
        or N.
      grip: what holds the target.

    Returns: the loop, without its diagram.

    Raises:
      ModelError: the model does not load.
      ScenarioError: a coordinate named in the scenario does not exist, or one lacks a gain.
      BlockError: a user-supplied block cannot be loaded, built or wired.

    Example:
      >>> from pydrake.systems.framework import DiagramBuilder
      >>> from ffsm_drake import add_closed_loop, load_scenario
      >>> builder = DiagramBuilder()
      >>> loop = add_closed_loop(builder, load_scenario("postcapture"))
      >>> diagram = builder.Build()
      >>> loop.plant.num_velocities()
      11
    """
    mission = make_mission(scenario)
    _check_coordinates(mission.scenario, mission.craft.coordinates)
    if plant is None:
        plant = builder.AddNamedSystem("plant", mission.craft.whole.Clone())
    made, parts = make_blocks(mission, mission.craft.nominal(grip), blocks)
    for system in made.values():
        builder.AddSystem(system)
    wiring = _Wiring(builder, plant, mission, made)
    wiring.connect(parts, joint_force)
    return ClosedLoop(
        parts=parts,
        mission=mission,
        plant=plant,
        blocks=made,
        sources=wiring.sources,
        grip=grip,
        joint_force=joint_force,
    )


def _check_coordinates(scenario: Scenario, coordinates: Coordinates) -> None:
    """Raise ScenarioError for a value of an unknown coordinate."""
    for name, posture in scenario.postures.items():
        configuration(coordinates, posture, key=name)
    for name in ("initial_velocity", "tolerance"):
        coordinates.check_names(getattr(scenario, name), key=name)


def make_closed_loop(
    scenario: Scenario | Mission, *, blocks: Mapping[str, Factory] | None = None, grip: Grip = HELD
) -> ClosedLoop:
    """Build the closed loop of a scenario as a Drake diagram.

    Arguments and errors are those of ``add_closed_loop``.

    Returns: the loop, with its diagram.

    Example:
      >>> from ffsm_drake import load_scenario, make_closed_loop
      >>> loop = make_closed_loop(load_scenario("postcapture"))
      >>> loop.diagram.GetGraphvizString(max_depth=1).startswith("digraph")
      True
    """
    builder = DiagramBuilder()
    return build_closed_loop(builder, add_closed_loop(builder, scenario, blocks=blocks, grip=grip))


def build_closed_loop(builder: DiagramBuilder, loop: ClosedLoop) -> ClosedLoop:
    """Build the diagram that a closed loop was added to, with the loop's signals as its outputs."""
    for signal in loop.sources:
        builder.ExportOutput(loop.output_port(signal), signal)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return dataclasses.replace(loop, diagram=diagram)


Source = tuple[System, str]  # a system, and the name of its output port


class _Wiring:
    """The connections between the blocks and the plant of a loop.

    A port reads the signal of its name, in ``_signals``: each step adds the outputs of some
    blocks, or others in place of what acted before, and feeds the blocks that read them.
    ``sources`` are the signals that are recorded.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        plant: MultibodyPlant,
        mission: Mission,
        blocks: Mapping[str, System],
    ) -> None:
        self._builder, self._plant, self._blocks = builder, plant, blocks
        self._coordinates, self._split = mission.craft.coordinates, mission.craft.split
        self._sample_time = mission.scenario.sample_time
        self._controller = blocks["controller"]
        self._stages, self._forces = (
            [system for name, system in blocks.items() if kind_of(name) == kind]
            for kind in ("sensing", "forces")
        )
        self._signals = self._states()
        self.sources = dict(self._signals)

    def connect(self, parts: Parts, joint_force: np.ndarray | None) -> None:
        """All steps; ``parts`` are those whose signals are recorded."""
        self._wire_sensing()
        self._wire_command()
        self._wire_actuation(joint_force)
        self._wire_forces()
        self._record(parts)

    def _wire_sensing(self) -> None:
        """The stages of sensing in a row: each reads the estimate of the one before."""
        self._signals["true_state"] = true = self._signals["state"]
        for stage in self._stages:
            self._connect_inputs(stage)
            self._add_outputs(stage, ("estimated_state", "measurement_is_new", ISOLATED))
            self._signals["state"] = self._signals["estimated_state"]
        self._signals["state"] = true
        self.sources["estimated_state"] = self._signals["estimated_state"]
        # Measurement of the controller's last sample, for the record.
        self.sources["measurement"] = self._hold("estimated_state", "measurement")

    def _wire_command(self) -> None:
        """From the planned motion to the command; a supervisor may change both."""
        motion, supervisor = BLOCKS["reference"], self._blocks.get("supervisor")
        self._add_outputs(self._blocks["reference"], (*motion.outputs, *motion.optional_outputs))
        self._add_outputs(self._controller, ("generalized_force",))
        asking = [(each, ABORT) for each in self._blocks.values() if each.HasOutputPort(ABORT)]
        if supervisor is not None:
            if asking and supervisor.HasInputPort(ABORT):
                self._signals[ABORT] = self._sum(ABORT, asking)
            self._connect_inputs(supervisor)
            ports = BLOCKS["supervisor"]
            self._add_outputs(supervisor, (*ports.outputs, *ports.optional_outputs))
        self._connect_inputs(self._controller)
        known = (*motion.outputs, *motion.optional_outputs, "generalized_force")
        self.sources |= {name: self._signals[name] for name in known if name in self._signals}

    def _wire_actuation(self, joint_force: np.ndarray | None) -> None:
        """From the command to the applied force, which the controller receives."""
        actuation, applied = self._blocks.get("actuation"), self._signals["generalized_force"]
        if actuation is not None:
            self._signals["commanded_force"] = applied
            self._connect_inputs(actuation)
            self._add_outputs(
                actuation, (*ADDED_FORCES, *REPORTED_FORCES, *REPORTED_UNITS, *READ_BY_FORCES)
            )
            applied = (actuation, "applied_force")
        # no force acts there for any command
        if joint_force is not None or self._coordinates.undriven:
            mask = self._coordinates.is_driven.astype(float)
            if joint_force is not None:
                mask[NUM_BASE_VELOCITIES:] = 0.0
            driven = self._builder.AddNamedSystem("driven_force", Gain(mask))
            self._builder.Connect(_port(applied), driven.get_input_port())
            applied = _output(driven)
        if joint_force is not None:
            whole = np.pad(joint_force, (NUM_BASE_VELOCITIES, 0))
            held = self._builder.AddNamedSystem("joint_force", ConstantVectorSource(whole))
            applied = self._sum("applied", [applied, _output(held)])
        self.sources["applied_force"] = applied
        self._signals["applied_force"] = self._signals.setdefault(TOLD, applied)
        self._connect_inputs(self._controller)
        # their measurements are wired
        self._connect_inputs(*self._stages, ports=(*REPORTED_FORCES, *REPORTED_UNITS))

    def _wire_forces(self) -> None:
        """All forces on the plant, along its own v: H q'' + C = tau + tau_d."""
        forces, own, hidden = self._forces, "generalized_force", "hidden_force"
        self._connect_inputs(*forces)
        last = [system for system in forces if system.HasInputPort("other_force")]
        first = [system for system in forces if system not in last]
        added = [self._signals[name] for name in ADDED_FORCES if name in self._signals]
        terms = [self.sources["applied_force"], *((system, own) for system in first), *added]
        acts = self._on_whole_plant("total", self._sum("total_force", terms), first)
        if last:
            self._signals["other_force"] = acts
            whole = self._on_whole_plant
            terms = [whole(each.get_name(), (each, own), [each]) for each in last]
            acts = self._sum("last_force", [acts, *terms])
        for system in forces:
            self._add_outputs(system, (WRENCH, JAM))
        self._connect_inputs(self._controller, *last)
        self._connect_inputs(*self._stages, ports=(WRENCH,))
        self._builder.Connect(_port(acts), self._plant.get_applied_generalized_force_input_port())
        now = {
            name: _at_once(system, own)
            for name, system in self._blocks.items()
            if system in forces and not any(map(system.HasInputPort, READ_BY_FORCES))
        }
        self.sources["disturbance_force"] = self._sum("external_force", [*now.values()])
        if on_hidden := [each for each in forces if each.HasOutputPort(hidden)]:
            name = "external_hidden_force"
            self.sources[name] = self._sum(name, [_at_once(each, hidden) for each in on_hidden])
        if len(now) > 1:
            self.sources |= {f"force_{each.partition('.')[2]}": now[each] for each in now}

    def _record(self, parts: Parts) -> None:
        """Record the optional outputs of the controller and the signals of parts; signals of
        sensing at the last control sample.
        """
        names = filter(self._controller.HasOutputPort, BLOCKS["controller"].optional_outputs)
        self.sources |= {name: (self._controller, name) for name in names}
        for name, part in parts.items():
            block = self._blocks.get(part.block)
            self.sources |= {each: (block, each) for each in part.part.logged}
            for signal in part.signals:
                if signal.name in self.sources:
                    problem = f"signal '{signal.name}' has the name of another; rename it"
                    raise BlockError(f"blocks.{name}: {problem}")
                if signal.of is not None:
                    continue
                self.sources[signal.name] = (block, signal.name)
                if kind_of(part.block) == "sensing":
                    held = self._hold(signal.name, f"{signal.name}_at_samples")
                    self.sources[signal.name] = held

    def _connect_inputs(self, *systems: System, ports: Iterable[str] | None = None) -> None:
        """Connect the input ports of systems, or those with some names, that read a signal and are
        not connected yet.
        """
        for system in systems:
            for name in filter(system.HasInputPort, self._signals if ports is None else ports):
                port = system.GetInputPort(name)
                if name in self._signals and not self._builder.IsConnectedOrExported(port):
                    self._builder.Connect(_port(self._signals[name]), port)

    def _add_outputs(self, system: System, names: Iterable[str]) -> None:
        """Add the outputs that a system has among some names."""
        self._signals |= {name: (system, name) for name in filter(system.HasOutputPort, names)}

    def _hold(self, source: str, name: str) -> Source:
        """Return the value of a recorded signal at the last control sample."""
        port = _port(self.sources[source])
        hold = self._builder.AddNamedSystem(name, ZeroOrderHold(self._sample_time, port.size()))
        self._builder.Connect(port, hold.get_input_port())
        return _output(hold)

    def _on_whole_plant(self, name: str, acts: Source, systems: list[System]) -> Source:
        """Combine a force on the known coordinates with those of systems on hidden coordinates."""
        if not self._split.names:
            return acts
        terms, of = [self._along(f"{name}_known_force", acts, self._split.known)], "hidden_force"
        if on_hidden := [(each, of) for each in systems if each.HasOutputPort(of)]:
            total = self._sum(f"{name}_hidden_sum", on_hidden)
            terms.append(self._along(f"{name}_hidden_force", total, self._split.hidden))
        return self._sum(f"{name}_whole_force", terms)

    def _along(self, name: str, force: Source, entries: np.ndarray) -> Source:
        """Return a force along some of the plant's velocities as one along all."""
        gain = MatrixGain(np.eye(self._plant.num_velocities())[:, entries])
        self._builder.AddNamedSystem(name, gain)
        self._builder.Connect(_port(force), gain.get_input_port())
        return _output(gain)

    def _states(self) -> dict[str, Source]:
        """Return the known state, and the hidden one if there is any, taken from the plant's."""
        split, state = self._split, self._plant.get_state_output_port()
        if not split.names:
            return {"state": (self._plant, "state")}
        entries = np.arange(state.size())
        parts = {"state": split.known_part(entries), "hidden_state": split.hidden_part(entries)}
        places = {name: [(0, int(i)) for i in of] for name, of in parts.items()}
        selector = make_selector({"whole_state": state.size()}, places)
        self._builder.AddNamedSystem("states", selector)
        self._builder.Connect(state, selector.get_input_port())
        return {name: (selector, name) for name in parts}

    def _sum(self, name: str, terms: list[Source]) -> Source:
        """Return the sum of ports; a single port is returned unchanged."""
        if len(terms) == 1:
            return terms[0]
        ports = list(map(_port, terms))
        adder = self._builder.AddNamedSystem(name, Adder(len(terms), ports[0].size()))
        for index, port in enumerate(ports):
            self._builder.Connect(port, adder.get_input_port(index))
        return _output(adder)


def _at_once(system: System, name: str) -> Source:
    """The output of a system after the update of a control sample, if it has one of its own."""
    after = f"{NEXT}{name}"
    return system, after if system.HasOutputPort(after) else name


def _output(system: System) -> Source:
    """The only output of a system."""
    return system, system.get_output_port().get_name()


def _port(source: Source) -> OutputPort:
    system, name = source
    return system.GetOutputPort(name)
