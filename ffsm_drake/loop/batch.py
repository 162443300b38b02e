"""Several closed loops in one diagram, which share one controller: its law works on all of them at once.

Plants, sensors, actuators and forces are each run's own; what a run gives is what it gives alone, to the bit.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import Demultiplexer, Multiplexer

from ffsm_drake.loop.blocks import block_choices
from ffsm_drake.loop.closed_loop import ClosedLoop, ControllerPorts, make_parts, ports_of, wire
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.spacecraft.plant import make_plant
from ffsm_drake.systems.controllers import SampledController
from ffsm_drake.systems.controllers.several import CannotShare, share_law

# Blocks that are functions of time alone, and the parts of a scenario that they depend on.
_SOURCES = {
    "reference": ("model", "sample_time", "initial_posture", "target_posture", "reference"),
    "forces.disturbance": ("model", "disturbance"),
}
# Integrators whose steps, without error control, treat every number of the state by itself.
_EXPLICIT = ("explicit_euler", "runge_kutta2", "runge_kutta3")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Batch:
    """The closed loops and what they share."""

    loops: tuple[ClosedLoop, ...]
    controller: SampledController


def batch_key(scenario: Scenario) -> Any:
    """Scenarios with equal keys may run together; None: this one runs alone."""
    config = scenario.simulator_config
    if config.use_error_control or config.integration_scheme not in _EXPLICIT:
        return None
    if block_choices(scenario) and config.max_step_size < scenario.sample_time:
        return None  # whose steps a user's block may divide, unnoticed
    alike = (scenario.controller, scenario.model, scenario.sample_time, config.integration_scheme)
    return repr((*alike, config.max_step_size, scenario.payload.body, scenario.blocks, scenario.python_path))


def add_batch(builder: DiagramBuilder, scenarios: Sequence[Scenario]) -> Batch:
    """Add the closed loops of scenarios with equal keys to a diagram.

    Raises:
      CannotShare: their controllers cannot work together.
      ModelError, ScenarioError, BlockError: as ``add_closed_loop``.
    """
    parts = [make_parts(scenario, make_nominal_plant(scenario)) for scenario in scenarios]
    own = [of.pop("controller") for of in parts]
    if not all(hasattr(controller, "law") for controller in own):
        raise CannotShare("the controller is a Drake system of its own")
    _share_sources(scenarios, parts)
    for k, of in enumerate(parts):
        for name, system in of.items():
            if k == 0 or system is not parts[0][name]:
                system.set_name(f"run_{k}.{system.get_name()}")
                builder.AddSystem(system)
    first, coordinates = scenarios[0], own[0].coordinates
    controller = builder.AddSystem(
        SampledController(
            share_law([each.law for each in own], coordinates),
            name=own[0].get_name(),
            coordinates=coordinates,
            sample_time=first.sample_time,
            runs=len(scenarios),
        )
    )
    slow = [of["sensing"].HasOutputPort("measurement_is_new") for of in parts]
    if len(set(slow)) > 1:
        raise CannotShare("only some have slow sensors")
    ports = _split_ports(builder, controller, len(scenarios), without=() if slow[0] else ("measurement_is_new",))
    loops = []
    for k, (scenario, of) in enumerate(zip(scenarios, parts, strict=True)):
        plant = builder.AddNamedSystem(f"run_{k}.plant", make_plant(scenario.model))
        loops.append(wire(builder, scenario, plant, of, ports[k], prefix=f"run_{k}."))
    return Batch(loops=tuple(loops), controller=controller)


def _share_sources(scenarios: Sequence[Scenario], parts: Sequence[dict[str, System]]) -> None:
    """Let runs with the same plan, or the same disturbance, take it from one system."""
    for name, sections in _SOURCES.items():
        if name in block_choices(scenarios[0]):  # a user's may be anything
            continue
        for scenario, of in zip(scenarios[1:], parts[1:], strict=True):
            if all(getattr(scenario, part) == getattr(scenarios[0], part) for part in sections):
                of[name] = parts[0][name]


def _split_ports(
    builder: DiagramBuilder, controller: SampledController, runs: int, *, without: Sequence[str]
) -> list[ControllerPorts]:
    """Each run's part of the ports of a controller that serves all."""
    ports = ports_of(controller)
    inputs, outputs = {}, {}
    for name, port in ports.inputs.items():
        if name not in without:
            inputs[name] = builder.AddNamedSystem(f"{name}s", Multiplexer([port.size() // runs] * runs))
            builder.Connect(inputs[name].get_output_port(), port)
    for name in ports.outputs:
        port = controller.GetOutputPort(name)
        outputs[name] = builder.AddNamedSystem(f"{name}s_of_runs", Demultiplexer(port.size(), port.size() // runs))
        builder.Connect(port, outputs[name].get_input_port())
    return [
        ControllerPorts(
            inputs={name: system.get_input_port(k) for name, system in inputs.items()},
            outputs={name: (system, system.get_output_port(k).get_name()) for name, system in outputs.items()},
        )
        for k in range(runs)
    ]
