"""Controllers: control laws as pure functions, and the one system around them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pydrake.systems.framework import System

from ffsm_drake.common.errors import BlockError, ScenarioError, did_you_mean
from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import CommandFilter, Scenario
from ffsm_drake.scenario.contacts import closing_contacts
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.closed_chains import CLOSED_CHAINS
from ffsm_drake.systems.controllers.controller import OPTIONAL_OUTPUTS, SMALLEST, SampledController
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    Gain,
    Sample,
    State,
    complete_gain,
    gain,
    gain_values,
    gains_of,
)
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics
from ffsm_drake.systems.registry import Factory, block_names, call_factory, find_factory, name_of
from ffsm_drake.systems.setup import BlockSetup

__all__ = [
    "OPTIONAL_OUTPUTS",
    "PAPER_LAWS",
    "SMALLEST",
    "ControlLaw",
    "InjectedDynamics",
    "Sample",
    "SampledController",
    "State",
    "complete_gains",
    "controller_factory",
    "controller_names",
    "controller_setup",
    "declared_gains",
    "gain",
    "gain_vectors",
    "gains_schema",
    "make_controller",
    "make_law",
]


# From a law and its setup, returns the law with filters of the scenario; by what sets them. Raises
# ScenarioError: an unknown coordinate, or a value that cannot be used.
FilterOfCommands = Callable[[Any, BlockSetup], Any]
COMMAND_FILTERS = Registry[FilterOfCommands]("command_filters")
PAPER_LAWS = ("tdc", "asmc", "aismc", "tde_aismc")  # the paper's comparison


def controller_names() -> tuple[str, ...]:
    """Return names of all controllers: shipped ones, then installed ones."""
    return block_names("controller")


def controller_setup(mission: Mission, nominal: PlantModel) -> BlockSetup:
    """Return the setup of the scenario's controller, with a model of the driven coordinates."""
    return BlockSetup(
        name=mission.scenario.controller_key,
        mission=mission,
        nominal=driven_model(nominal),
        settings=mission.scenario.gains,
    )


def make_controller(
    mission: Mission, nominal: PlantModel, factory: Factory | None = None
) -> System:
    """Return the controller of a mission, a system with its name (the part after the colon).

    Args:
      mission: its scenario names the controller and the gains.
      nominal: the plant with the nominal payload; the controller's own.
      factory: replaces the scenario's choice: BlockSetup -> control law or Drake system. The
        system keeps the scenario's name.

    Raises:
      ScenarioError: an unknown controller or gain, gains of unknown or missing coordinates.
      BlockError: a user-supplied controller cannot be loaded or built.
    """
    if factory is not None:
        mission = mission.flown_by(controller=name_of(factory))
    scenario, setup = mission.scenario, controller_setup(mission, nominal)
    _check_other_gains(scenario, setup.coordinates)
    if closing_contacts(scenario, nominal.grip) and scenario.chain.law != "plain":
        in_chain = CLOSED_CHAINS.only("chain.law").law
        made = in_chain(setup, lambda own: _make(own, factory))
    else:
        made = _make(setup, factory)
    if isinstance(made, type):
        place = f"controller '{scenario.controller}'"
        raise BlockError(f"{place} must be a control law or a Drake system, not a class of them")
    is_law = hasattr(made, "initial_state") and hasattr(made, "step")
    law, filters = made, scenario.command_filter
    if replace(filters, barriers=None) != CommandFilter():
        law = COMMAND_FILTERS.load("filters", "command_filter")(law, setup)
    if filters.barriers:
        law = COMMAND_FILTERS.load("barriers", "command_filter.barriers")(law, setup)
    if is_law:
        return SampledController(
            law,
            name=setup.name,
            coordinates=setup.coordinates,
            sample_time=setup.sample_time,
            place=f"controller '{scenario.controller}'",
            restarts=scenario.supervisor is not None,
        )
    if law is not made:
        raise ScenarioError(
            "command_filter", f"is for control laws; '{setup.name}' is a Drake system of its own"
        )
    return made


def make_law(mission: Mission, nominal: PlantModel) -> Any:
    """Return the control law of a mission, such as TimeDelayControl.

    Raises: the errors of ``make_controller``.
    """
    return _make(controller_setup(mission, nominal), None)


def gain_vectors(scenario: Scenario, coordinates: Coordinates) -> dict[str, Any]:
    """Return gains of the scenario's controller, by name: vectors (nv) or numbers; see
    ``gain_values``.

    Empty for a controller that declares none. Raises ScenarioError and BlockError as
    ``make_controller`` does.
    """
    factory = controller_factory(scenario)
    return (
        gain_values(factory, scenario.gains, coordinates, name=scenario.controller_key)
        if gains_of(factory)
        else {}
    )


def declared_gains(scenario: Scenario) -> dict[str, Gain]:
    """Return declared gains of the scenario's controller, by name; empty if it declares none."""
    return gains_of(controller_factory(scenario))


def complete_gains(scenario: Scenario) -> Scenario:
    """Return the scenario with all gains of its controller written out, including defaults."""
    declared, given = declared_gains(scenario), scenario.gains
    if not declared:
        return scenario
    gains = {
        name: complete_gain(item, *([given[name]] if name in given else []))
        for name, item in declared.items()
    }
    return scenario.with_gains(gains)


def gains_schema() -> dict[str, Any]:
    """JSON Schema of the gains of every shipped or installed controller, by controller."""
    number = {"type": "number"}
    by_name = {"type": "object", "additionalProperties": number}
    schema = {}
    for name in controller_names():
        gains = gains_of(find_factory("controller", name))
        properties = {
            gain_name: {
                "anyOf": [number, by_name, *([{"type": "null"}] if item.bound else [])],
                "description": "; ".join(filter(None, (item.unit, item.meaning))),
                "default": item.default,
            }
            for gain_name, item in gains.items()
        }
        schema[name] = {
            "type": "object",
            "properties": properties,
            "additionalProperties": not gains,
        }
    return schema


def _check_other_gains(scenario: Scenario, coordinates: Coordinates) -> None:
    """Raise ScenarioError for a wrong gain of another controller, or a misspelt controller."""
    names, own = controller_names(), scenario.controller_key
    for key, given in scenario.controllers.items():
        if key in names and key != own:
            gain_values(find_factory("controller", key), given, coordinates, name=key)
        elif key != own and (remedy := did_you_mean(key, [*names, own])):
            # others may be a user's
            raise ScenarioError(f"controllers.{key}", f"unknown controller{remedy}")


def _make(setup: BlockSetup, factory: Factory | None) -> Any:
    place = f"controller '{setup.scenario.controller}'"
    return call_factory(factory or controller_factory(setup.scenario), setup, place=place)


def controller_factory(scenario: Scenario) -> Factory:
    """Return the factory of the scenario's controller, such as the class of its law. Raises the
    errors of ``make_controller``.
    """
    return find_factory("controller", scenario.controller, python_path=scenario.python_path)
