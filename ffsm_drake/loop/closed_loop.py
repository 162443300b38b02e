"""The closed loop: reference, controller, disturbance, plant and sensing wired into one Diagram."""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.geometry import CollisionFilterDeclaration, Meshcat, MeshcatVisualizer
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, OutputPort, System
from pydrake.systems.primitives import Adder, LogVectorOutput, Multiplexer, VectorLogSink

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.spacecraft.plant import add_combined_plant, configuration, coordinates_of, make_plant
from ffsm_drake.systems.actuation import make_actuation
from ffsm_drake.systems.controllers import OPTIONAL_OUTPUTS, make_controller
from ffsm_drake.systems.controllers.time_delay import TimeDelayController
from ffsm_drake.systems.disturbance import make_disturbance
from ffsm_drake.systems.reference import QuinticReference, make_reference
from ffsm_drake.systems.sensing import make_sensing

# Outputs of the diagram that every closed loop has; those of OPTIONAL_OUTPUTS come on top that the controller gives.
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
    """The closed loop's diagram and handles to its parts.

    The diagram's outputs are ``SIGNALS``, then those of ``OPTIONAL_OUTPUTS`` that the controller has. With a logger
    they are recorded every control sample (but for ``estimated_state``), stacked as ``logged`` says.
    """

    scenario: Scenario
    diagram: Diagram
    plant: MultibodyPlant
    coordinates: Coordinates
    reference: QuinticReference
    controller: LeafSystem
    actuation: Diagram | None  # None: what is commanded acts
    disturbance: System
    sensing: Diagram
    logger: VectorLogSink | None
    logged: Mapping[str, slice]  # signal -> its rows of the log

    def initialize(self, root: System, root_context: Context) -> None:
        """Seed the noise, give the plant its payload and put it into the initial posture, at the initial velocity.

        Args:
          root: this diagram, or the diagram that holds it.
          root_context: a context of ``root``.
        """
        scenario = self.scenario
        # First, because it resets every state and parameter of the diagram.
        root.SetRandomContext(root_context, RandomGenerator(scenario.random_seed))
        context = self.plant.GetMyMutableContextFromRoot(root_context)
        set_payload(self.plant, context, body=scenario.payload.body, properties=scenario.payload.truth)
        self.plant.SetPositions(context, configuration(self.plant, scenario.initial_posture, key="initial_posture"))
        velocity = self.coordinates.vector(scenario.initial_velocity, key="initial_velocity", default=0.0)
        self.plant.SetVelocities(context, velocity)
        if self.sensing.HasSubsystemNamed("delay"):
            # Before the start, the spacecraft was where it is now.
            delay = self.sensing.GetSubsystemByName("delay")
            state = self.plant.GetPositionsAndVelocities(context)
            delay_context = delay.GetMyMutableContextFromRoot(root_context)
            delay_context.SetDiscreteState(np.tile(state, self.scenario.sensing.delay))


def make_closed_loop(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    log: bool = False,
    own_disturbance: Callable[[Coordinates], System] | None = None,
    make_operator: Callable[[Coordinates], LeafSystem] | None = None,
) -> ClosedLoop:
    """Build the closed loop of a scenario.

    Args:
      scenario: what to build.
      meshcat: makes its visualizer part of the diagram.
      log: makes a logger of all signals part of the diagram: one, behind a multiplexer, is cheaper than one for each.
      own_disturbance: makes the source of the external force in place of the scenario's harmonics; its output
        ``generalized_force`` (nv) is base torque and force in world axes and joint torques, N m and N.
      make_operator: makes a system that stands between the disturbance and the plant. Its inputs are ``disturbance``
        (nv) and ``state`` (nq + nv), its outputs ``external_force`` (nv), which acts on the plant, and
        ``next_external_force`` (nv), that just after the update of a control sample: the output ``disturbance_force``.

    Raises:
      ModelError: the model does not load.
      ScenarioError: a coordinate named in the scenario does not exist, or one lacks a gain.
    """
    builder = DiagramBuilder()
    plant = _add_plant(builder, scenario.model, shown=meshcat is not None)
    coordinates = coordinates_of(plant)
    for name in ("initial_posture", "target_posture"):
        configuration(plant, getattr(scenario, name), key=name)
    coordinates.check_names(scenario.initial_velocity, key="initial_velocity")
    reference = builder.AddNamedSystem("reference", make_reference(scenario, coordinates))
    controller = builder.AddSystem(make_controller(scenario, make_nominal_plant(scenario)))
    if own_disturbance is None:
        disturbance: System = make_disturbance(scenario.disturbance, coordinates)
    else:
        disturbance = _checked_disturbance(own_disturbance(coordinates), coordinates)
    builder.AddSystem(disturbance)
    sensing = builder.AddSystem(make_sensing(scenario.sensing, coordinates, sample_time=scenario.sample_time))
    actuation = make_actuation(scenario.actuation, coordinates, sample_time=scenario.sample_time)
    total_force = builder.AddNamedSystem("total_force", Adder(2, len(coordinates.names)))

    builder.Connect(plant.get_state_output_port(), sensing.GetInputPort("state"))
    builder.Connect(sensing.GetOutputPort("estimated_state"), controller.GetInputPort("estimated_state"))
    for name in ("desired_state", "desired_acceleration"):
        builder.Connect(reference.GetOutputPort(name), controller.GetInputPort(name))
    # tau_d acts on the plant from outside: H q'' + C = tau + tau_d.
    commanded_force = applied_force = controller.GetOutputPort("generalized_force")
    if actuation is not None:
        builder.AddSystem(actuation)
        builder.Connect(commanded_force, actuation.get_input_port())
        applied_force = actuation.GetOutputPort("applied_force")
    builder.Connect(applied_force, total_force.get_input_port(0))
    # Ours knows what it commanded; to read it elsewhere takes time.
    if controller.HasInputPort("applied_force") and not (
        actuation is None and isinstance(controller, TimeDelayController)
    ):
        builder.Connect(applied_force, controller.GetInputPort("applied_force"))
    external_force = recorded_force = disturbance.GetOutputPort("generalized_force")
    if make_operator is not None:
        operator = builder.AddNamedSystem("operator", make_operator(coordinates))
        builder.Connect(external_force, operator.GetInputPort("disturbance"))
        builder.Connect(plant.get_state_output_port(), operator.GetInputPort("state"))
        external_force = operator.GetOutputPort("external_force")
        recorded_force = operator.GetOutputPort("next_external_force")
    builder.Connect(external_force, total_force.get_input_port(1))
    builder.Connect(total_force.get_output_port(), plant.get_applied_generalized_force_input_port())
    if meshcat is not None:
        visualizer = MeshcatVisualizer.AddToBuilder(builder, builder.GetSubsystemByName("scene_graph"), meshcat)
        visualizer.set_name("meshcat_visualizer")

    outputs = (
        plant.get_state_output_port(),
        sensing.GetOutputPort("estimated_state"),
        sensing.GetOutputPort("measurement"),
        reference.GetOutputPort("desired_state"),
        reference.GetOutputPort("desired_acceleration"),
        commanded_force,
        applied_force,
        recorded_force,
    )
    sources = dict(zip(SIGNALS, outputs, strict=True))
    sources |= {name: controller.GetOutputPort(name) for name in OPTIONAL_OUTPUTS if controller.HasOutputPort(name)}
    for name, port in sources.items():
        builder.ExportOutput(port, name)
    del sources["estimated_state"]  # what was read of it is the measurement
    if actuation is None:
        del sources["applied_force"]
    logger, logged = _add_logger(builder, sources, scenario.sample_time) if log else (None, {})
    if log and actuation is None:
        logged["applied_force"] = logged["generalized_force"]
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return ClosedLoop(
        scenario=scenario,
        diagram=diagram,
        plant=plant,
        coordinates=coordinates,
        reference=reference,
        controller=controller,
        actuation=actuation,
        disturbance=disturbance,
        sensing=sensing,
        logger=logger,
        logged=logged,
    )


def _add_plant(builder: DiagramBuilder, model: Model, *, shown: bool) -> MultibodyPlant:
    """Add the plant; the geometry is dear to load, so it is there only to be shown. Bodies never touch."""
    if not shown:
        return builder.AddNamedSystem("plant", make_plant(model))
    plant = add_combined_plant(builder, model)
    scene_graph = builder.GetSubsystemByName("scene_graph")
    bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
    nothing_touches = CollisionFilterDeclaration().ExcludeWithin(plant.CollectRegisteredGeometries(bodies))
    scene_graph.collision_filter_manager().Apply(nothing_touches)
    return plant


def _add_logger(
    builder: DiagramBuilder, sources: Mapping[str, OutputPort], period: float
) -> tuple[VectorLogSink, dict[str, slice]]:
    """A logger of all sources, sampled together, and each one's rows in its log."""
    sizes = [port.size() for port in sources.values()]
    stacked = builder.AddNamedSystem("signals", Multiplexer(sizes))
    for index, port in enumerate(sources.values()):
        builder.Connect(port, stacked.get_input_port(index))
    logger = LogVectorOutput(stacked.get_output_port(), builder, period)
    ends = np.cumsum(sizes).tolist()
    return logger, {name: slice(end - size, end) for name, size, end in zip(sources, sizes, ends, strict=True)}


def _checked_disturbance(source: System, coordinates: Coordinates) -> System:
    size = len(coordinates.names)
    if not source.HasOutputPort("generalized_force") or source.GetOutputPort("generalized_force").size() != size:
        raise ScenarioError("own_disturbance", f"needs an output port 'generalized_force' of size {size}")
    if not source.get_name():
        source.set_name(type(source).__name__)  # Drake's own choice differs from run to run
    return source
