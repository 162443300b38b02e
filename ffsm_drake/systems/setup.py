"""Inputs of a block's factory."""

import dataclasses
import functools
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    InputPort,
    OutputPort,
    System,
)

from ffsm_drake.common.errors import some
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import Grip, MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.nominal import PlantModel


class _Settings(dict[str, Any]):
    """Settings whose KeyError lists the valid keys."""

    def __missing__(self, key: object) -> Any:
        raise KeyError(f"no '{key}' in the scenario's settings; there are: {some(self)}")


class CompositeBlock(Diagram):
    """A block of several systems, connected by signals; it passes the initial state to them.

    An input port reads the signal of its name: the last output so named among the systems before
    its own, else an input of the block, else an output of a later system.
    """

    def __init__(
        self,
        name: str,
        systems: Mapping[str, System],
        *,
        inputs: Collection[str],
        outputs: Collection[str] = (),
        signals: Mapping[str, Mapping[str, str]] = {},
    ) -> None:
        """Args:
        name: of the block.
        systems: by name.
        inputs: signals that may come from outside the block.
        outputs: signals that it puts out; default: all but ``inputs``.
        signals: by name of a system, signals of ports of other names.
        """
        super().__init__()
        builder, made, exported = DiagramBuilder(), dict[str, OutputPort](), set[str]()
        waiting = list[tuple[str, InputPort]]()
        for key, system in systems.items():
            builder.AddNamedSystem(key, system)
            own = signals.get(key, {})
            for port_name, port in inputs_of(system).items():
                signal = own.get(port_name, port_name)
                if signal in made:
                    builder.Connect(made[signal], port)
                elif signal in exported:
                    builder.ConnectInput(signal, port)
                elif signal in inputs:
                    builder.ExportInput(port, signal)
                    exported.add(signal)
                else:
                    waiting.append((signal, port))
            for port_name, port in outputs_of(system).items():
                made[own.get(port_name, port_name)] = port
        for signal, port in waiting:
            builder.Connect(made[signal], port)
        for signal in outputs or [each for each in made if each not in inputs]:
            builder.ExportOutput(made[signal], signal)
        builder.BuildInto(self)
        self.set_name(name)

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """The spacecraft was at ``state`` [q; v] before the start."""
        self._tell("set_initial_state", context, state)

    def set_payload(self, context: Context, properties: MassProperties) -> None:
        """Give the payload other mass properties."""
        self._tell("set_payload", context, properties)

    def _tell(self, method: str, context: Context, what: Any) -> None:
        """Call a method of the systems that have it."""
        for system in self.GetSystems():
            if hasattr(system, method):
                getattr(system, method)(self.GetMutableSubsystemContext(system, context), what)


def inputs_of(system: System) -> dict[str, InputPort]:
    """Return the input ports of a system by name."""
    ports = map(system.get_input_port, range(system.num_input_ports()))
    return {port.get_name(): port for port in ports}


def outputs_of(system: System) -> dict[str, OutputPort]:
    """Return the output ports of a system by name."""
    ports = map(system.get_output_port, range(system.num_output_ports()))
    return {port.get_name(): port for port in ports}


@dataclasses.dataclass(frozen=True, kw_only=True)
class BlockSetup:
    """Input of a block's factory, which returns a Drake system with the ports of the block.

    The factory of a controller can return a control law instead. A controller must use only
    ``nominal``. ``true`` is for blocks of its environment, such as sensors and forces.

    Example:
      >>> from ffsm_drake import BlockSetup, load_scenario
      >>> from ffsm_drake.mission import Mission
      >>> mission = Mission(load_scenario("postcapture"))
      >>> given = {"nominal": mission.craft.nominal(), "settings": {"gain": 2.0}}
      >>> setup = BlockSetup(name="drag", mission=mission, **given)
      >>> setup.settings["gain"], setup.sample_time, len(setup.coordinates.names)
      (2.0, 0.01, 11)
    """

    name: str  # the system's name in the diagram
    mission: Mission  # the scenario, its spacecraft, and what is planned
    nominal: PlantModel  # the plant with the nominal payload
    settings: Mapping[str, Any]  # as the scenario gives them to this block

    def __post_init__(self) -> None:
        object.__setattr__(self, "settings", _Settings(self.settings))

    @property
    def scenario(self) -> Scenario:
        """The scenario of the run."""
        return self.mission.scenario

    @property
    def craft(self) -> Craft:
        """The spacecraft, of which a controller must use only ``nominal`` models."""
        return self.mission.craft

    @property
    def split(self) -> StateSplit:
        """Known and hidden coordinates of the true plant, unknown to any controller."""
        return self.craft.split

    @property
    def coordinates(self) -> Coordinates:
        """Names of the generalized velocities."""
        return self.nominal.coordinates

    @property
    def grip(self) -> Grip:
        """What holds the target."""
        return self.nominal.grip

    @property
    def sample_time(self) -> float:
        """The control period L, s."""
        return self.scenario.sample_time

    @functools.cached_property
    def true(self) -> PlantModel:
        """The plant with the true payload, with its own context."""
        return self.craft.true(self.grip)
