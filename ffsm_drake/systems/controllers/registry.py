"""Finding a controller by name: the paper's four, an installed entry point, or ``module:attribute``."""

import importlib
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from pydrake.systems.framework import LeafSystem

from ffsm_drake.common.errors import ControllerError, FfsmError, did_you_mean, one_line
from ffsm_drake.scenario import CONTROLLER_NAMES, ENTRY_POINT_GROUP, Scenario, own_controller_name
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.sampled import ControllerSetup

Factory = Callable[[ControllerSetup], LeafSystem]


def controller_names() -> tuple[str, ...]:
    """Every controller that can be named without a module: the paper's four, then the installed ones."""
    return CONTROLLER_NAMES + tuple(sorted(entry_points(group=ENTRY_POINT_GROUP).names))


def find_factory(name: str) -> Factory:
    """The factory of a controller that is not one of the paper's four.

    Args:
      name: an entry point of the group ``ffsm_drake.controllers``, or ``module:attribute``.

    Raises ControllerError when it cannot be imported or called.
    """
    try:
        if ":" in name:
            module, _, attribute = name.partition(":")
            factory: Any = importlib.import_module(module)
            for part in attribute.split("."):
                if not hasattr(factory, part):
                    near = [other for other, value in vars(factory).items() if callable(value)]
                    raise ControllerError(f"controller '{name}': {module} has no '{part}'{did_you_mean(part, near)}")
                factory = getattr(factory, part)
        else:
            found = entry_points(group=ENTRY_POINT_GROUP, name=name)
            if not found:
                raise ControllerError(
                    f"controller '{name}' is unknown; choose one of {', '.join(controller_names())}, "
                    f"or give module:Class{did_you_mean(name, controller_names())}"
                )
            factory = next(iter(found)).load()
    except FfsmError:
        raise
    except ModuleNotFoundError as error:
        raise ControllerError(
            f"controller '{name}' cannot be loaded: {one_line(error)}; "
            "run from the folder that holds it, or put that on PYTHONPATH"
        ) from error
    except (Exception, SystemExit) as error:  # whatever a user's module does when it is imported
        raise ControllerError(
            f"controller '{name}' cannot be loaded: {type(error).__name__}: {one_line(error)}"
        ) from error
    if not callable(factory):
        raise ControllerError(f"controller '{name}' must be a class or function, not {type(factory).__name__}")
    checked: Factory = factory
    return checked


def build_controller(factory: Factory, setup: ControllerSetup) -> LeafSystem:
    """Call a factory and check that what it returns can be wired. Raises ControllerError if not."""
    try:
        controller = factory(setup)
    except FfsmError:
        raise
    except (Exception, SystemExit) as error:
        raise ControllerError(
            f"controller '{setup.name}' cannot be built: {type(error).__name__}: {one_line(error)}"
        ) from error
    if not isinstance(controller, LeafSystem):
        raise ControllerError(f"controller '{setup.name}' must be a LeafSystem, not {type(controller).__name__}")
    check_ports(controller, setup)
    controller.set_name(setup.name)
    return controller


def check_ports(controller: LeafSystem, setup: ControllerSetup) -> None:
    """Raise ControllerError unless the controller has the contract's ports, with the right sizes."""
    num_velocities = len(setup.coordinates.names)
    num_states = 2 * num_velocities + 1
    inputs = {
        "estimated_state": num_states,
        "desired_state": num_states,
        "desired_acceleration": num_velocities,
        "applied_force": num_velocities,
    }
    given = [controller.get_input_port(i).get_name() for i in range(controller.num_input_ports())]
    for name in given:
        if name not in inputs:
            raise ControllerError(f"controller '{setup.name}': unknown input port '{name}'; known: {', '.join(inputs)}")
    for name, size in inputs.items():
        if name not in given and name != "applied_force":
            raise ControllerError(f"controller '{setup.name}': needs an input port '{name}' of size {size}")
        if name in given and controller.GetInputPort(name).size() != size:
            raise ControllerError(
                f"controller '{setup.name}': input port '{name}' must have size {size}, "
                f"not {controller.GetInputPort(name).size()}"
            )
    if not controller.HasOutputPort("generalized_force"):
        raise ControllerError(
            f"controller '{setup.name}': needs an output port 'generalized_force' of size {num_velocities}"
        )
    for i in range(controller.num_output_ports()):
        port = controller.get_output_port(i)
        if port.size() != num_velocities:
            raise ControllerError(
                f"controller '{setup.name}': output port '{port.get_name()}' must have size {num_velocities}, "
                f"not {port.size()}"
            )
        if controller.HasDirectFeedthrough(i):
            raise ControllerError(
                f"controller '{setup.name}': output port '{port.get_name()}' must not follow an input at once; declare "
                "it with DeclareStateOutputPort, or with prerequisites {self.all_state_ticket()}"
            )


def setup_for(scenario: Scenario, nominal: PlantModel) -> ControllerSetup:
    """What the scenario's own controller is built from."""
    name = own_controller_name(scenario.controller)
    return ControllerSetup(
        name=name, nominal=nominal, sample_time=scenario.sample_time, gains=scenario.controllers.own.get(name, {})
    )
