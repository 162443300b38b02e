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
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, OutputPort, System
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Gain,
    Selector,
    ZeroOrderHold,
)

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.guard import calling, guarded, is_user_supplied
from ffsm_drake.loop.blocks import (
    ABORT,
    BESIDES,
    BLOCKS,
    FROM_ACTUATORS,
    ISOLATED,
    OF_ACTUATORS,
    TOLD,
    WRENCH,
    make_blocks,
)
from ffsm_drake.scenario import HELD, Grip, MassProperties, Scenario, kind_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates, StateSplit
from ffsm_drake.spacecraft.nominal import (
    PlantModel,
    change_payload,
    make_nominal_plant,
    set_true_masses,
)
from ffsm_drake.spacecraft.plant import configuration, coordinates_of, make_plant, split_of
from ffsm_drake.spacecraft.start import state_at_start
from ffsm_drake.systems.controllers.sampled import SampledController
from ffsm_drake.systems.part import EFFORT, Parts, Signal
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.selection import make_selector
from ffsm_drake.systems.sensing.stages import wire_stages

# Signals of every closed loop. Further signals: the controller's OPTIONAL_OUTPUTS, the actuators'
# outputs, "hidden_state" with hidden coordinates, and "force_<name>" for each of several external
# forces.
SIGNALS = (
    "state",
    "estimated_state",
    "measurement",
    "desired_state",
    "desired_acceleration",
    "generalized_force",
    "applied_force",
    "disturbance_force",
)
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
class ClosedLoop:
    """The plant and the connected blocks of a closed loop.

    Example:
      >>> from ffsm_drake import load_scenario, make_closed_loop
      >>> loop = make_closed_loop(load_scenario("postcapture"))
      >>> list(loop.blocks)
      ['reference', 'sensing', 'controller', 'forces.disturbance']
      >>> loop.diagram.num_input_ports()
      0
    """

    scenario: Scenario
    plant: MultibodyPlant  # the true one, with hidden coordinates
    coordinates: Coordinates
    split: StateSplit
    # "reference", "sensing", "controller", "forces.disturbance", other forces; "actuation" unless
    # it is ideal
    blocks: Mapping[str, System]
    # signal -> the system and the name of its output port
    sources: Mapping[str, tuple[System, str]]
    parts: Parts = dataclasses.field(default_factory=dict)  # parts among ``blocks``
    grip: Grip = HELD  # what holds the target
    diagram: Any = None  # the Diagram, after ``make_closed_loop``; its outputs are the signals

    @property
    def tracks_frame(self) -> bool:
        """True if the controller tracks a frame's pose, and coordinates only in its null space."""
        return bool(self.blocks["controller"].HasInputPort("desired_frame"))

    def output_port(self, signal: str) -> OutputPort:
        """Return the port of a signal of SIGNALS; ``disturbance_force`` sums the external
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
        set_true_masses(self.plant, context, scenario, self.grip)
        for placed in self.parts.values():
            placed.part.check_plant(scenario, self.model(context))
        self._tell("set_payload", root_context, self.grip.carried(scenario.payload).truth)
        self.set_whole_state(root_context, state_at_start(scenario, self.model(context)))

    def true_model(self, scenario: Scenario) -> PlantModel:
        """Return the plant in a new context with a scenario's true masses."""
        context = self.plant.CreateDefaultContext()
        set_true_masses(self.plant, context, scenario, self.grip)
        return self.model(context)

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
        change_payload(self.plant, context, self.scenario, properties)
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
        state: np.ndarray = self.plant.GetPositionsAndVelocities(context)
        return state

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
            if isinstance(block, SampledController) and (is_afresh or reference is not None):
                block.resume(context, other, then, None if is_afresh else reference)
            elif not is_afresh:
                context.SetStateAndParametersFrom(then)


@guarded
def add_closed_loop(
    builder: DiagramBuilder,
    scenario: Scenario,
    *,
    blocks: Mapping[str, Factory] | None = None,
    plant: MultibodyPlant | None = None,
    joint_force: np.ndarray | None = None,
    grip: Grip = HELD,
) -> ClosedLoop:
    """Add the closed loop of a scenario to a Drake diagram.

    Args:
      builder: the builder of the diagram.
      scenario: the scenario to build.
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
    if plant is None:
        plant = builder.AddNamedSystem("plant", make_plant(scenario.model, flexible=True))
    coordinates, split = coordinates_of(plant, undriven=scenario.undriven), split_of(plant)
    _check_coordinates(scenario, plant, coordinates)
    nominal = make_nominal_plant(scenario, grip)
    blocks_by_name, parts = make_blocks(scenario, nominal, blocks, split)
    for system in blocks_by_name.values():
        builder.AddSystem(system)
    wiring = _Wiring(builder, plant, coordinates, split, blocks_by_name, scenario.sample_time)
    wiring.connect(parts, joint_force)
    return ClosedLoop(
        parts=parts,
        scenario=scenario,
        plant=plant,
        coordinates=coordinates,
        split=split,
        blocks=blocks_by_name,
        sources=wiring.sources,
        grip=grip,
    )


def _check_coordinates(scenario: Scenario, plant: MultibodyPlant, coordinates: Coordinates) -> None:
    """Raise ScenarioError for a value of an unknown coordinate."""
    for name, posture in scenario.postures.items():
        configuration(plant, posture, key=name)
    for name in ("initial_velocity", "tolerance"):
        coordinates.check_names(getattr(scenario, name), key=name)


def make_closed_loop(
    scenario: Scenario, *, blocks: Mapping[str, Factory] | None = None, grip: Grip = HELD
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
    """The connections between the blocks and the plant of a loop, in steps; ``sources`` are its
    signals so far.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        plant: MultibodyPlant,
        coordinates: Coordinates,
        split: StateSplit,
        blocks: Mapping[str, System],
        sample_time: float,
    ) -> None:
        self._builder, self._plant, self._sample_time = builder, plant, sample_time
        self._coordinates, self._split, self._blocks = coordinates, split, blocks
        self._controller, self._actuation = blocks["controller"], blocks.get("actuation")
        self._forces = self._of_kind("forces")
        self._supervisor = blocks.get("supervisor")
        self._states = self._add_states() if split.names else {"state": (plant, "state")}
        self.sources: dict[str, Source] = dict(self._states)

    def connect(self, parts: Parts, joint_force: np.ndarray | None) -> None:
        """All steps; ``parts`` are those whose signals are recorded."""
        self.measure()
        self.follow()
        self.actuate(joint_force)
        self.act()
        self.record_controller()
        self.record_parts(parts)

    def measure(self) -> None:
        """The stages of sensing in a row, from the plant to the controller."""
        stages = list(self._of_kind("sensing").values())
        row = wire_stages(self._builder, stages)
        for port in row.inputs:
            self._connect("state", port)
        self._builder.Connect(row.estimated_state, self._controller.GetInputPort("estimated_state"))
        new = "measurement_is_new"
        if row.measurement_is_new is not None and self._controller.HasInputPort(new):
            self._builder.Connect(row.measurement_is_new, self._controller.GetInputPort(new))
        self.sources["estimated_state"] = (stages[-1], "estimated_state")
        # Measurement of the controller's last sample, for the record.
        self.sources["measurement"] = self._hold("estimated_state", "measurement")

    def follow(self) -> None:
        """The planned motion, from the reference to the controller."""
        reference, ports = self._blocks["reference"], BLOCKS["reference"]
        for name in (*ports.outputs, *ports.optional_outputs):
            if reference.HasOutputPort(name):
                self.sources[name] = (reference, name)
                if self._supervisor is not None and self._supervisor.HasInputPort(name):
                    self._connect(name, self._supervisor.GetInputPort(name))
                    self.sources[name] = (self._supervisor, name)
                if self._controller.HasInputPort(name):
                    self._connect(name, self._controller.GetInputPort(name))

    def actuate(self, joint_force: np.ndarray | None) -> None:
        """Wire the actuators; the controller receives the applied force."""
        controller, actuation, name = self._controller, self._actuation, "applied_force"
        self.sources["generalized_force"] = applied = (controller, "generalized_force")
        if self._supervisor is not None:
            self.sources["generalized_force"] = applied = self._supervise(self._supervisor)
        if actuation is not None:
            self._connect("generalized_force", actuation.GetInputPort("commanded_force"))
            self._give_states(actuation)
            applied = (actuation, name)
        # no force acts there for any command
        if joint_force is not None or self._coordinates.undriven:
            mask = self._coordinates.is_driven.astype(float)
            if joint_force is not None:
                mask[NUM_BASE_VELOCITIES:] = 0.0
            driven = self._builder.AddNamedSystem("driven_force", Gain(mask))
            self._builder.Connect(_port(applied), driven.get_input_port())
            applied = (driven, driven.get_output_port().get_name())
        if joint_force is not None:
            whole = np.pad(joint_force, (NUM_BASE_VELOCITIES, 0))
            held = self._builder.AddNamedSystem("joint_force", ConstantVectorSource(whole))
            applied = self._sum("applied", [applied, (held, held.get_output_port().get_name())])
        self.sources[name] = applied
        if actuation is not None and actuation.HasOutputPort(TOLD):
            applied = (actuation, TOLD)
        if controller.HasInputPort(name):
            self._builder.Connect(_port(applied), controller.GetInputPort(name))
        self._tell_of_actuators(applied)

    def _tell_of_actuators(self, told: Source) -> None:
        """Wire the fault-detecting stages of sensing to the actuators."""
        for stage in self._of_kind("sensing").values():
            found = {TOLD: told}
            if self._actuation is not None:
                found |= {
                    name: (self._actuation, name)
                    for name in OF_ACTUATORS[1:]
                    if self._actuation.HasOutputPort(name)
                }
                if stage.HasOutputPort(ISOLATED) and self._actuation.HasInputPort(ISOLATED):
                    port = self._actuation.GetInputPort(ISOLATED)
                    self._builder.Connect(stage.GetOutputPort(ISOLATED), port)
            for name in filter(stage.HasInputPort, found):
                self._builder.Connect(_port(found[name]), stage.GetInputPort(name))

    def _supervise(self, supervisor: System) -> Source:
        """Return the command of a supervisor, from the law's force and the blocks' requests."""
        self._connect("estimated_state", supervisor.GetInputPort("estimated_state"))
        self._connect("generalized_force", supervisor.GetInputPort("generalized_force"))
        asking = [each for each in self._blocks.values() if each.HasOutputPort(ABORT)]
        if asking and supervisor.HasInputPort(ABORT):
            self.sources[ABORT] = self._sum(ABORT, [(each, ABORT) for each in asking])
            self._connect(ABORT, supervisor.GetInputPort(ABORT))
            del self.sources[ABORT]
        if self._controller.HasInputPort("restart") and supervisor.HasOutputPort("restart"):
            restart = supervisor.GetOutputPort("restart")
            self._builder.Connect(restart, self._controller.GetInputPort("restart"))
        return supervisor, "generalized_force"

    def act(self) -> None:
        """All forces on the plant, along its own v: H q'' + C = tau + tau_d."""
        forces, builder, name = self._forces, self._builder, "generalized_force"
        for system in forces.values():
            self._give_states(system)
            for port in filter(system.HasInputPort, FROM_ACTUATORS):
                if self._actuation is not None and self._actuation.HasOutputPort(port):
                    builder.Connect(self._actuation.GetOutputPort(port), system.GetInputPort(port))
        last = [system for system in forces.values() if system.HasInputPort("other_force")]
        others = [(system, name) for system in forces.values() if system not in last]
        total = [self.sources["applied_force"], *others]
        if self._actuation is not None:
            besides = filter(self._actuation.HasOutputPort, BESIDES)
            total += [(self._actuation, each) for each in besides]
        acts = self._sum("total_force", total)
        if last:
            for system in last:
                builder.Connect(_port(acts), system.GetInputPort("other_force"))
            acts = self._sum("last_force", [acts, *((system, name) for system in last)])
        if self._controller.HasInputPort(WRENCH):
            for system in forces.values():
                if system.HasOutputPort(WRENCH):
                    builder.Connect(
                        system.GetOutputPort(WRENCH), self._controller.GetInputPort(WRENCH)
                    )
        on_hidden = [system for system in forces.values() if system.HasOutputPort("hidden_force")]
        if self._split.names:
            acts = self._on_whole_plant(acts, on_hidden)
        builder.Connect(_port(acts), self._plant.get_applied_generalized_force_input_port())
        now = {
            each: (system, f"next_{name}" if system.HasOutputPort(f"next_{name}") else name)
            for each, system in forces.items()
            if not any(map(system.HasInputPort, FROM_ACTUATORS))
        }
        self.sources["disturbance_force"] = self._sum("external_force", list(now.values()))
        if on_hidden:
            hidden, own = "external_hidden_force", "hidden_force"
            ports = [(system, f"next_{own}") for system in on_hidden]
            ports = [each if each[0].HasOutputPort(each[1]) else (each[0], own) for each in ports]
            self.sources[hidden] = self._sum(hidden, ports)
        if len(now) > 1:
            self.sources |= {f"force_{each.partition('.')[2]}": now[each] for each in now}

    def record_controller(self) -> None:
        """Record the controller's optional outputs."""
        names = filter(self._controller.HasOutputPort, BLOCKS["controller"].optional_outputs)
        self.sources |= {name: (self._controller, name) for name in names}

    def record_parts(self, parts: Parts) -> None:
        """Record the signals of parts; signals of sensing at the last control sample."""
        for name, part in parts.items():
            self.sources |= {each: (self._blocks[part.block], each) for each in part.part.logged}
            for signal in part.signals:
                if signal.name in self.sources:
                    problem = f"signal '{signal.name}' has the name of another; rename it"
                    raise BlockError(f"blocks.{name}: {problem}")
                if signal.of is not None:
                    continue
                self.sources[signal.name] = (self._blocks[part.block], signal.name)
                if kind_of(part.block) == "sensing":
                    held = self._hold(signal.name, f"{signal.name}_at_samples")
                    self.sources[signal.name] = held

    def _of_kind(self, kind: str) -> dict[str, System]:
        return {name: system for name, system in self._blocks.items() if kind_of(name) == kind}

    def _connect(self, source: str, port: InputPort) -> None:
        self._builder.Connect(_port(self.sources[source]), port)

    def _give_states(self, system: System) -> None:
        """The states that a system reads."""
        for name in filter(system.HasInputPort, self._states):
            self._connect(name, system.GetInputPort(name))

    def _hold(self, source: str, name: str) -> Source:
        """Return the value of a signal at the last control sample."""
        port = _port(self.sources[source])
        hold = self._builder.AddNamedSystem(name, ZeroOrderHold(self._sample_time, port.size()))
        self._builder.Connect(port, hold.get_input_port())
        return hold, hold.get_output_port().get_name()

    def _on_whole_plant(self, acts: Source, on_hidden: list[System]) -> Source:
        """Combine a force on the known coordinates with forces of systems on hidden coordinates."""
        nv, nh = len(self._coordinates.names), len(self._split.names)
        terms = {"known_force": (_port(acts), self._split.known)}
        if on_hidden:
            forces = [(system, "hidden_force") for system in on_hidden]
            terms["hidden_force"] = (
                _port(self._sum("total_hidden_force", forces)),
                self._split.hidden,
            )
        else:
            zero = ConstantVectorSource(np.zeros(nh))
            self._builder.AddNamedSystem("no_hidden_force", zero)
            terms["hidden_force"] = (zero.get_output_port(), self._split.hidden)
        origin = {
            int(entry): (index, offset)
            for index, (_, entries) in enumerate(terms.values())
            for offset, entry in enumerate(entries)
        }
        places = list(map(origin.__getitem__, range(nv + nh)))
        sizes = {name: port.size() for name, (port, _) in terms.items()}
        whole = self._select("whole_force", sizes, {"whole_force": places})
        for index, (port, _) in enumerate(terms.values()):
            self._builder.Connect(port, whole.get_input_port(index))
        return whole, "whole_force"

    def _add_states(self) -> dict[str, Source]:
        """Return the known and the hidden state, taken from the plant's."""
        size, split = self._plant.num_multibody_states(), self._split
        entries = np.arange(size)
        parts = {"state": split.known_part(entries), "hidden_state": split.hidden_part(entries)}
        places = {name: [(0, int(i)) for i in of] for name, of in parts.items()}
        selector = self._select("states", {"whole_state": size}, places)
        self._builder.Connect(self._plant.get_state_output_port(), selector.get_input_port())
        return {name: (selector, name) for name in parts}

    def _select(
        self, name: str, inputs: Mapping[str, int], outputs: Mapping[str, list[tuple[int, int]]]
    ) -> Selector:
        """Return a system with entries of its inputs as outputs: for each, the input and the place
        in it.
        """
        selector: Selector = self._builder.AddNamedSystem(name, make_selector(inputs, outputs))
        return selector

    def _sum(self, name: str, terms: list[Source]) -> Source:
        """Return the sum of ports; a single port is returned unchanged."""
        if len(terms) == 1:
            return terms[0]
        ports = list(map(_port, terms))
        adder = self._builder.AddNamedSystem(name, Adder(len(terms), ports[0].size()))
        for index, port in enumerate(ports):
            self._builder.Connect(port, adder.get_input_port(index))
        return adder, adder.get_output_port().get_name()


def _port(source: Source) -> OutputPort:
    system, name = source
    return system.GetOutputPort(name)
