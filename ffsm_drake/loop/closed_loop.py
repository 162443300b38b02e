"""The closed loop: the blocks and the plant, wired into one Diagram.

               +-----------+                                          forces (summed)
    reference->|           |   commanded   +-----------+   applied          |
               | controller|-------------->| actuation |-----------------> (+) --> plant --+--> state
     estimated>|           |     force     +-----------+    force                          |
               +-----------+                                                               |
         ^------------------------------- sensing <----------------------------------------+

``loop.blocks`` says what each block's ports are, and what fills it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import Adder, ZeroOrderHold

from ffsm_drake.loop.blocks import kind_of, make_blocks
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.capture import planned_contact
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.mass_properties import set_payload, set_wheels
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration, coordinates_of, make_plant
from ffsm_drake.systems.actuation import HELD_OUTPUTS, STORED_MOMENTUM
from ffsm_drake.systems.controllers import OPTIONAL_OUTPUTS
from ffsm_drake.systems.controllers.sampled import SampledController
from ffsm_drake.systems.registry import Factory

# Signals of every closed loop. OPTIONAL_OUTPUTS come on top that the controller gives, those that the actuators
# give, and "force_<name>" for each external force where there are several.
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
    plant: MultibodyPlant
    coordinates: Coordinates
    # "reference", "sensing", "controller", "forces.disturbance", other forces; "actuation" unless it is ideal
    blocks: Mapping[str, System]
    sources: Mapping[str, tuple[System, str]]  # signal -> the system and the name of its output port
    diagram: Any = None  # Diagram, of ``make_closed_loop``; its outputs are the signals

    def output_port(self, signal: str) -> OutputPort:
        """The port of a signal; see SIGNALS. ``disturbance_force`` is the sum of the external forces."""
        system, name = self.sources[signal]
        return system.GetOutputPort(name)

    def initialize(self, root: System, root_context: Context) -> None:
        """Seed the noise, give the plant its payload and put it into the initial posture, at the initial velocity.

        Args:
          root: the diagram that holds the loop.
          root_context: a context of ``root``.
        """
        scenario = self.scenario
        # First, because it resets every state and parameter of the diagram.
        root.SetRandomContext(root_context, RandomGenerator(scenario.random_seed))
        context = self.plant.GetMyMutableContextFromRoot(root_context)
        set_payload(self.plant, context, body=scenario.payload.body, properties=scenario.payload.truth)
        set_wheels(self.plant, context, scenario.wheels)
        position = configuration(self.plant, scenario.initial_posture, key="initial_posture")
        velocity = self.coordinates.vector(scenario.initial_velocity, key="initial_velocity", default=0.0)
        if scenario.capture is not None:
            model = PlantModel(plant=self.plant, context=context, coordinates=self.coordinates)
            velocity += planned_contact(scenario, model).grasp.velocity
        self.set_state(root_context, np.concatenate([position, velocity]))

    def set_state(self, root_context: Context, state: np.ndarray) -> None:
        """Put the plant into a state [q; v], and the blocks into one in which nothing else was before."""
        self.plant.SetPositionsAndVelocities(self.plant.GetMyMutableContextFromRoot(root_context), state)
        for block in self.blocks.values():
            if hasattr(block, "set_initial_state"):
                block.set_initial_state(block.GetMyMutableContextFromRoot(root_context), state)

    def resume(
        self, root_context: Context, before: "ClosedLoop", context_before: Context, reference: np.ndarray
    ) -> None:
        """Let the blocks go on where those of another loop, of the same scenario but for its payload, have come to.

        Args:
          root_context: of this loop.
          before: the other loop.
          context_before: of that.
          reference: [q_d; v_d] with which this loop's motion begins.
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
      builder: of the diagram.
      scenario: what to build.
      blocks: block -> factory (BlockSetup -> Drake system) in place of what the scenario says, such as
        ``{"sensing": Vicon, "forces.friction": Friction}``; see ``loop.blocks``.
      plant: the plant, if it is part of the diagram already (``add_combined_plant``, to show it); one without geometry
        is added otherwise.

    Raises:
      ModelError: the model does not load.
      ScenarioError: a coordinate named in the scenario does not exist, or one lacks a gain.
      BlockError: a user-supplied block cannot be loaded, built or wired.
    """
    if plant is None:
        plant = builder.AddNamedSystem("plant", make_plant(scenario.model))
    coordinates = coordinates_of(plant)
    for name, posture in scenario.postures.items():
        configuration(plant, posture, key=name)
    for name in ("initial_velocity", "tolerance"):
        coordinates.check_names(getattr(scenario, name), key=name)
    parts = make_blocks(scenario, make_nominal_plant(scenario), blocks)
    for system in parts.values():
        builder.AddSystem(system)
    controller, sensing, reference = parts["controller"], parts["sensing"], parts["reference"]
    actuation = parts.get("actuation")

    state = plant.get_state_output_port()
    builder.Connect(state, sensing.GetInputPort("state"))
    # What the controller read at its last sample, for the record.
    measurement = ZeroOrderHold(scenario.sample_time, 2 * len(coordinates.names) + 1)
    builder.AddNamedSystem("measurement", measurement)
    builder.Connect(sensing.GetOutputPort("estimated_state"), measurement.get_input_port())
    builder.Connect(sensing.GetOutputPort("estimated_state"), controller.GetInputPort("estimated_state"))
    if sensing.HasOutputPort("measurement_is_new") and controller.HasInputPort("measurement_is_new"):
        builder.Connect(sensing.GetOutputPort("measurement_is_new"), controller.GetInputPort("measurement_is_new"))
    for name in ("desired_state", "desired_acceleration"):
        builder.Connect(reference.GetOutputPort(name), controller.GetInputPort(name))
    applied = (controller, "generalized_force")
    if actuation is not None:
        builder.Connect(controller.GetOutputPort("generalized_force"), actuation.GetInputPort("commanded_force"))
        if actuation.HasInputPort("state"):
            builder.Connect(state, actuation.GetInputPort("state"))
        applied = (actuation, "applied_force")
    if controller.HasInputPort("applied_force"):
        builder.Connect(applied[0].GetOutputPort(applied[1]), controller.GetInputPort("applied_force"))

    # External forces act on the plant beside the control: H q'' + C = tau + tau_d.
    forces = {name: system for name, system in parts.items() if kind_of(name) == "forces"}
    for system in forces.values():
        if system.HasInputPort("state"):
            builder.Connect(state, system.GetInputPort("state"))
    acting = {name: (system, "generalized_force") for name, system in forces.items()}
    recorded = {
        name: (system, "next_generalized_force")
        if system.HasOutputPort("next_generalized_force")
        else (system, "generalized_force")
        for name, system in forces.items()
    }
    if actuation is not None and actuation.HasOutputPort("gyroscopic_force"):
        acting["gyroscopic"] = (actuation, "gyroscopic_force")
    total = _sum(builder, "total_force", [applied, *acting.values()], coordinates)
    builder.Connect(total[0].get_output_port(), plant.get_applied_generalized_force_input_port())

    sources = {
        "state": (plant, "state"),
        "estimated_state": (sensing, "estimated_state"),
        "measurement": (measurement, measurement.get_output_port().get_name()),
        "desired_state": (reference, "desired_state"),
        "desired_acceleration": (reference, "desired_acceleration"),
        "generalized_force": (controller, "generalized_force"),
        "applied_force": applied,
        "disturbance_force": _sum(builder, "external_force", list(recorded.values()), coordinates),
    }
    if len(forces) > 1:
        sources |= {f"force_{name.partition('.')[2]}": source for name, source in recorded.items()}
    sources |= {name: (controller, name) for name in OPTIONAL_OUTPUTS if controller.HasOutputPort(name)}
    if actuation is not None:
        further = (*HELD_OUTPUTS, STORED_MOMENTUM)
        sources |= {name: (actuation, name) for name in further if actuation.HasOutputPort(name)}
    return ClosedLoop(scenario=scenario, plant=plant, coordinates=coordinates, blocks=parts, sources=sources)


def make_closed_loop(scenario: Scenario, *, blocks: Mapping[str, Factory] | None = None) -> ClosedLoop:
    """The closed loop of a scenario as a diagram of its own; arguments and errors as for ``add_closed_loop``."""
    builder = DiagramBuilder()
    return build_closed_loop(builder, add_closed_loop(builder, scenario, blocks=blocks))


def build_closed_loop(builder: DiagramBuilder, loop: ClosedLoop) -> ClosedLoop:
    """Build the diagram that a closed loop was added to, with the loop's signals as its outputs."""
    for signal in loop.sources:
        builder.ExportOutput(loop.output_port(signal), signal)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return dataclasses.replace(loop, diagram=diagram)


def _sum(
    builder: DiagramBuilder, name: str, terms: list[tuple[System, str]], coordinates: Coordinates
) -> tuple[System, str]:
    """The sum of ports, itself as a system and its port; a single one is its own sum."""
    if len(terms) == 1:
        return terms[0]
    adder = builder.AddNamedSystem(name, Adder(len(terms), len(coordinates.names)))
    for index, (system, port) in enumerate(terms):
        builder.Connect(system.GetOutputPort(port), adder.get_input_port(index))
    return adder, adder.get_output_port().get_name()
