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
from collections.abc import Container, Mapping
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import (
    Adder,
    Gain,
    MatrixGain,
    Selector,
    SelectorParams,
    ZeroOrderHold,
)

from ffsm_drake.common.errors import BlockError, ScenarioError
from ffsm_drake.loop.blocks import BESIDES, kind_of, make_blocks
from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.spacecraft.capture import planned_contact
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates, StateSplit
from ffsm_drake.spacecraft.nominal import (
    PlantModel,
    change_payload,
    make_nominal_plant,
    set_true_masses,
)
from ffsm_drake.spacecraft.plant import configuration, coordinates_of, make_plant, split_of
from ffsm_drake.systems.actuation.drives import DriveSet
from ffsm_drake.systems.controllers import OPTIONAL_OUTPUTS, SMALLEST
from ffsm_drake.systems.controllers.sampled import SampledController
from ffsm_drake.systems.part import Parts
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.sensing import wire_stages

# Integration schemes that are stable at any step, for any friction.
IMPLICIT_SCHEMES = ("implicit_euler", "velocity_implicit_euler", "radau1", "radau3")
# Signals of every closed loop. Added to them: the OPTIONAL_OUTPUTS that the controller has, those
# of the actuators, "hidden_state" with hidden coordinates, and "force_<name>" for each external
# force if there are several.
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """The plant and the blocks of a closed loop, wired."""

    scenario: Scenario
    plant: MultibodyPlant  # the true one, with hidden coordinates
    coordinates: Coordinates
    split: StateSplit
    # "reference", "sensing", "controller", "forces.disturbance", other forces; "actuation" unless
    # it is ideal
    blocks: Mapping[str, System]
    # signal -> the system and the name of its output port
    sources: Mapping[str, tuple[System, str]]
    parts: Parts = dataclasses.field(default_factory=dict)  # those of ``blocks`` that are parts
    diagram: Any = None  # the Diagram, after ``make_closed_loop``; its outputs are the signals

    @property
    def tracks_frame(self) -> bool:
        """True if the controller tracks a frame's pose, and coordinates only in its null space."""
        return bool(self.blocks["controller"].HasInputPort("desired_frame"))

    def output_port(self, signal: str) -> OutputPort:
        """The port of a signal of SIGNALS; ``disturbance_force`` sums the external forces."""
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
        set_true_masses(self.plant, context, scenario)
        self._check_friction(context)
        self._tell_blocks(root_context, scenario.payload.truth)
        position = configuration(self.plant, scenario.initial_posture, key="initial_posture")
        velocity = self.coordinates.vector(
            scenario.initial_velocity, key="initial_velocity", default=0.0
        )
        state = self.split.whole(np.concatenate([position, velocity]))
        if scenario.capture is not None:
            contact = planned_contact(scenario, self.model(context))
            state[self.plant.num_positions() :] += contact.grasp.velocity
        self.set_whole_state(root_context, state)

    def model(self, plant_context: Context) -> PlantModel:
        """The plant in one of its contexts, for computations."""
        return PlantModel(
            plant=self.plant,
            context=plant_context,
            coordinates=self.coordinates,
            split=self.split,
        )

    def _check_friction(self, context: Context) -> None:
        """Raise ScenarioError if a fixed step does not resolve a joint's friction near rest."""
        scenario, config = self.scenario, self.scenario.simulator_config
        if (
            scenario.drives is None
            or config.use_error_control
            or config.integration_scheme in IMPLICIT_SCHEMES
        ):
            return
        drives = DriveSet(scenario.drives, scenario.actuation.limit, self.coordinates)
        if not drives.has_friction:
            return
        whole = np.arange(self.plant.num_velocities())
        joints = self.split.known_velocities(whole)[NUM_BASE_VELOCITIES:]
        for name, posture in scenario.postures.items():
            q = self.split.whole_positions(configuration(self.plant, posture, key=name))
            mobility = np.linalg.inv(self.model(context).calc_mass_matrix(q))[
                np.ix_(joints, joints)
            ]
            constant, joint = drives.time_constant(mobility)
            if config.max_step_size > constant:
                raise ScenarioError(
                    "simulator_config.max_step_size",
                    f"{config.max_step_size:g} s does not resolve the friction of {joint}, which "
                    "near rest has a time constant of "
                    f"{constant:.2g} s ({name}): take at most {0.9 * constant:.2g} s, or "
                    f"{1.1 * config.max_step_size / constant:.2g} times the "
                    "actuation.drives.smoothing_rate",
                )

    def set_payload(self, root_context: Context, properties: MassProperties) -> None:
        """Set the payload's true mass properties in the plant and in the blocks that use them."""
        context = self.plant.GetMyMutableContextFromRoot(root_context)
        change_payload(self.plant, context, self.scenario, properties)
        self._tell_blocks(root_context, properties)

    def _tell_blocks(self, root_context: Context, properties: MassProperties) -> None:
        for block in self.blocks.values():
            if hasattr(block, "set_payload"):
                block.set_payload(block.GetMyMutableContextFromRoot(root_context), properties)

    def set_state(self, root_context: Context, state: np.ndarray) -> None:
        """Set the plant to a known state [q; v], and reset the blocks, without history, to it."""
        self.set_whole_state(root_context, self.split.whole(state))

    def set_whole_state(self, root_context: Context, state: np.ndarray) -> None:
        """As ``set_state``, for the plant's own [q; v], which includes the hidden state."""
        self.plant.SetPositionsAndVelocities(
            self.plant.GetMyMutableContextFromRoot(root_context), state
        )
        self.set_blocks(root_context, self.split.known_part(state))

    def set_blocks(self, root_context: Context, state: np.ndarray) -> None:
        """Reset the blocks, without history, to a known state [q; v]."""
        for block in self.blocks.values():
            if hasattr(block, "set_initial_state"):
                block.set_initial_state(block.GetMyMutableContextFromRoot(root_context), state)

    def resume(
        self,
        root_context: Context,
        before: "ClosedLoop",
        context_before: Context,
        reference: np.ndarray,
    ) -> None:
        """Continue the blocks from another loop's state; its scenario differs in the payload only.

        Args:
          root_context: this loop's root context.
          before: the other loop.
          context_before: the other loop's root context.
          reference: [q_d; v_d] where this loop's motion begins.
        """
        for name, block in self.blocks.items():
            other = before.blocks[name]
            context, source = (
                block.GetMyMutableContextFromRoot(root_context),
                other.GetMyContextFromRoot(context_before),
            )
            if isinstance(block, SampledController):
                block.resume(context, other, source, reference)
            else:
                context.SetStateAndParametersFrom(source)


def add_closed_loop(
    builder: DiagramBuilder,
    scenario: Scenario,
    *,
    blocks: Mapping[str, Factory] | None = None,
    plant: MultibodyPlant | None = None,
) -> ClosedLoop:
    """Add the closed loop of a scenario to a diagram.

    Args:
      builder: the diagram's builder.
      scenario: the scenario to build.
      blocks: block -> factory (BlockSetup -> Drake system) that replaces the scenario's choice,
        such as ``{"sensing": Vicon, "forces.friction": Friction}``; see ``loop.blocks``.
      plant: the plant, if the diagram has it already (``add_combined_plant``, to show it);
        otherwise one without geometry is added.

    Raises:
      ModelError: the model does not load.
      ScenarioError: a coordinate named in the scenario does not exist, or one lacks a gain.
      BlockError: a user-supplied block cannot be loaded, built or wired.
    """
    if plant is None:
        plant = builder.AddNamedSystem("plant", make_plant(scenario.model, flexible=True))
    coordinates, split = coordinates_of(plant, undriven=scenario.undriven), split_of(plant)
    for name, posture in scenario.postures.items():
        configuration(plant, posture, key=name)
    for name in ("initial_velocity", "tolerance"):
        coordinates.check_names(getattr(scenario, name), key=name)
    parts, placed = make_blocks(scenario, make_nominal_plant(scenario), blocks, split)
    for system in parts.values():
        builder.AddSystem(system)
    controller, reference = parts["controller"], parts["reference"]
    stages = [system for name, system in parts.items() if kind_of(name) == "sensing"]

    states = {"state": (plant, "state")}
    if split.names:
        states = _add_states(builder, plant, split)
    state = states["state"][0].GetOutputPort(states["state"][1])
    measured = _measure(builder, state, stages, controller)
    # The measurement of the controller's last sample, for the record.
    measurement = ZeroOrderHold(scenario.sample_time, 2 * len(coordinates.names) + 1)
    builder.AddNamedSystem("measurement", measurement)
    builder.Connect(measured, measurement.get_input_port())
    for name in ("desired_state", "desired_acceleration"):
        builder.Connect(reference.GetOutputPort(name), controller.GetInputPort(name))
    if reference.HasOutputPort("desired_frame") and controller.HasInputPort("desired_frame"):
        builder.Connect(
            reference.GetOutputPort("desired_frame"), controller.GetInputPort("desired_frame")
        )
    applied = _actuate(builder, state, controller, parts.get("actuation"), coordinates)

    forces = {name: system for name, system in parts.items() if kind_of(name) == "forces"}
    on_hidden = [system for system in forces.values() if system.HasOutputPort("hidden_force")]
    recorded = {
        name: (system, "next_generalized_force")
        if system.HasOutputPort("next_generalized_force")
        else (system, "generalized_force")
        for name, system in forces.items()
    }
    besides = _besides(parts.get("actuation"))
    acts = _add_forces(builder, plant, split, states, [applied], forces, besides, on_hidden)
    builder.Connect(acts, plant.get_applied_generalized_force_input_port())

    sources = {
        **states,
        "estimated_state": (stages[-1], "estimated_state"),
        "measurement": (measurement, measurement.get_output_port().get_name()),
        "desired_state": (reference, "desired_state"),
        "desired_acceleration": (reference, "desired_acceleration"),
        "generalized_force": (controller, "generalized_force"),
        "applied_force": applied,
        "disturbance_force": _sum(builder, "external_force", list(recorded.values())),
    }
    if on_hidden:
        now = [(system, "next_hidden_force") for system in on_hidden]
        sources["external_hidden_force"] = _sum(builder, "external_hidden_force", now)
    if len(forces) > 1:
        sources |= {f"force_{name.partition('.')[2]}": source for name, source in recorded.items()}
    optional = (*OPTIONAL_OUTPUTS, SMALLEST)
    sources |= {name: (controller, name) for name in optional if controller.HasOutputPort(name)}
    if reference.HasOutputPort("desired_frame"):
        sources["desired_frame"] = (reference, "desired_frame")
    sources |= _sources_of_parts(builder, scenario, parts, placed, taken=sources)
    return ClosedLoop(
        parts=placed,
        scenario=scenario,
        plant=plant,
        coordinates=coordinates,
        split=split,
        blocks=parts,
        sources=sources,
    )


def make_closed_loop(
    scenario: Scenario, *, blocks: Mapping[str, Factory] | None = None
) -> ClosedLoop:
    """The closed loop of a scenario as a diagram of its own; arguments and errors as for
    ``add_closed_loop``.
    """
    builder = DiagramBuilder()
    return build_closed_loop(builder, add_closed_loop(builder, scenario, blocks=blocks))


def build_closed_loop(builder: DiagramBuilder, loop: ClosedLoop) -> ClosedLoop:
    """Build the diagram that a closed loop was added to, with the loop's signals as its outputs."""
    for signal in loop.sources:
        builder.ExportOutput(loop.output_port(signal), signal)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return dataclasses.replace(loop, diagram=diagram)


def _measure(
    builder: DiagramBuilder, state: OutputPort, stages: list[System], controller: System
) -> OutputPort:
    """Wire the stages of sensing in a row, up to the controller; what the last one gives."""
    row = wire_stages(builder, stages)
    for port in row.inputs:
        builder.Connect(state, port)
    builder.Connect(row.estimated_state, controller.GetInputPort("estimated_state"))
    new = "measurement_is_new"
    if row.measurement_is_new is not None and controller.HasInputPort(new):
        builder.Connect(row.measurement_is_new, controller.GetInputPort(new))
    return row.estimated_state


def _actuate(
    builder: DiagramBuilder,
    state: OutputPort,
    controller: System,
    actuation: System | None,
    coordinates: Coordinates,
) -> tuple[System, str]:
    """Wire the actuators behind the controller, which hears of the force that they apply; that
    force.
    """
    applied = (controller, "generalized_force")
    if actuation is not None:
        commanded = controller.GetOutputPort("generalized_force")
        builder.Connect(commanded, actuation.GetInputPort("commanded_force"))
        if actuation.HasInputPort("state"):
            builder.Connect(state, actuation.GetInputPort("state"))
        applied = (actuation, "applied_force")
    if coordinates.undriven:  # no force acts there, whatever is commanded
        driven = Gain(coordinates.is_driven.astype(float))
        builder.AddNamedSystem("driven_force", driven)
        builder.Connect(applied[0].GetOutputPort(applied[1]), driven.get_input_port())
        applied = (driven, driven.get_output_port().get_name())
    if controller.HasInputPort("applied_force"):
        port = applied[0].GetOutputPort(applied[1])
        builder.Connect(port, controller.GetInputPort("applied_force"))
    return applied


def _besides(actuation: System | None) -> list[tuple[System, str]]:
    """The ports of actuators that act on the plant beside the applied force."""
    if actuation is None:
        return []
    return [(actuation, name) for name in BESIDES if actuation.HasOutputPort(name)]


def _add_forces(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    split: StateSplit,
    states: Mapping[str, tuple[System, str]],
    control: list[tuple[System, str]],
    forces: Mapping[str, System],
    besides: list[tuple[System, str]],
    on_hidden: list[System],
) -> OutputPort:
    """The sum of all forces on the plant, along its own v: H q'' + C = tau + tau_d.

    Args:
      builder: the diagram's builder.
      plant: the true one.
      split: its hidden coordinates.
      states: name -> port of the states that forces may read.
      control: the applied force.
      forces: the external forces, by block.
      besides: further forces of the actuators.
      on_hidden: those of the forces that act on hidden coordinates too.
    """
    for system in forces.values():
        for name, (source, port) in states.items():
            if system.HasInputPort(name):
                builder.Connect(source.GetOutputPort(port), system.GetInputPort(name))
    external = [(system, "generalized_force") for system in forces.values()]
    total = _sum(builder, "total_force", [*control, *external, *besides])
    acts = total[0].GetOutputPort(total[1])
    if not split.names:
        return acts
    every = np.eye(plant.num_velocities())
    on_known = builder.AddNamedSystem("known_force", MatrixGain(every[:, split.known]))
    builder.Connect(acts, on_known.get_input_port())
    if not on_hidden:
        return on_known.get_output_port()
    total = _sum(builder, "total_hidden_force", [(system, "hidden_force") for system in on_hidden])
    gain = builder.AddNamedSystem("hidden_force", MatrixGain(every[:, split.hidden]))
    builder.Connect(total[0].GetOutputPort(total[1]), gain.get_input_port())
    whole = _sum(builder, "whole_force", [(on_known, "y0"), (gain, "y0")])
    return whole[0].GetOutputPort(whole[1])


def _sources_of_parts(
    builder: DiagramBuilder,
    scenario: Scenario,
    systems: Mapping[str, System],
    parts: Parts,
    *,
    taken: Container[str],
) -> dict[str, tuple[System, str]]:
    """The ports of the parts' signals; those of sensing as they were at the last sample."""
    found: dict[str, tuple[System, str]] = {}
    for name, part in parts.items():
        for signal in part.signals:
            if signal.name in taken or signal.name in found:
                problem = f"signal '{signal.name}' has the name of another; rename it"
                raise BlockError(f"blocks.{name}: {problem}")
            if signal.of is not None:
                continue
            found[signal.name] = (systems[part.block], signal.name)
            if kind_of(part.block) == "sensing":
                hold = ZeroOrderHold(scenario.sample_time, signal.size)
                builder.AddNamedSystem(f"{signal.name}_at_samples", hold)
                port = systems[part.block].GetOutputPort(signal.name)
                builder.Connect(port, hold.get_input_port())
                found[signal.name] = (hold, hold.get_output_port().get_name())
    return found


def _add_states(
    builder: DiagramBuilder, plant: MultibodyPlant, split: StateSplit
) -> dict[str, tuple[System, str]]:
    """The known and the hidden state, taken from the plant's."""
    params = SelectorParams()
    params.inputs = [
        SelectorParams.InputPortParams(name="whole_state", size=plant.num_multibody_states())
    ]
    params.outputs = [
        SelectorParams.OutputPortParams(
            name=name,
            selections=[
                SelectorParams.OutputSelection(input_port_index=0, input_offset=int(i))
                for i in entries
            ],
        )
        for name, entries in (("state", split.known_state), ("hidden_state", split.hidden_state))
    ]
    selector = builder.AddNamedSystem("states", Selector(params))
    builder.Connect(plant.get_state_output_port(), selector.get_input_port())
    return {name: (selector, name) for name in ("state", "hidden_state")}


def _sum(builder: DiagramBuilder, name: str, terms: list[tuple[System, str]]) -> tuple[System, str]:
    """The sum of ports, as a system and its port's name; a single port is returned as it is."""
    if len(terms) == 1:
        return terms[0]
    ports = [system.GetOutputPort(port) for system, port in terms]
    adder = builder.AddNamedSystem(name, Adder(len(terms), ports[0].size()))
    for index, port in enumerate(ports):
        builder.Connect(port, adder.get_input_port(index))
    return adder, adder.get_output_port().get_name()
