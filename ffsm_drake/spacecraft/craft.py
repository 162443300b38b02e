"""The spacecraft of a scenario, parsed once: its plants, coordinates, limits and models."""

import dataclasses
import functools
from typing import ClassVar

from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from ffsm_drake.scenario import HELD, Grip, MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit
from ffsm_drake.spacecraft.extensions import TRUE_GEOMETRY
from ffsm_drake.spacecraft.limits import Limit, urdf_limits
from ffsm_drake.spacecraft.mass_properties import set_drives, set_payload, set_wheels
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import coordinates_of, flexible_parts, parsed_plant, split_of


class Craft:
    """The spacecraft of a scenario.

    A model that it returns has a context of its own, which its owner may change.
    """

    constants: ClassVar[tuple[()]] = ()  # no code that is traced depends on it

    def __init__(self, scenario: Scenario) -> None:
        """Args: names the model, and has the masses of payload, wheels and drives.

        Raises ModelError: the model cannot be loaded.
        """
        self._scenario, self.model = scenario, scenario.model
        self.rigid: MultibodyPlant = parsed_plant(scenario.model)  # flexible parts are locked
        self.whole: MultibodyPlant = parsed_plant(scenario.model, flexible=True)
        self.coordinates: Coordinates = coordinates_of(self.rigid, undriven=scenario.undriven)
        self.split: StateSplit = split_of(self.whole)
        self._made = dict[tuple[str, bool], PlantModel]()

    @functools.cached_property
    def limits(self) -> tuple[Limit, ...]:
        """Limits of the joints in the URDFs. Raises ModelError: a URDF cannot be read."""
        return tuple(urdf_limits(self.model, self.rigid, self.coordinates))

    def nominal(self, grip: Grip = HELD) -> PlantModel:
        """Return the model with the nominal payload, as a controller uses it.

        Args: what holds the target; if nothing does, the model has no payload.
        """
        return self._model("nominal", grip)

    def true(self, grip: Grip = HELD) -> PlantModel:
        """Return the model with the true payload and locked flexible parts; see ``nominal``."""
        return self._model("true", grip)

    def flexible(self, grip: Grip = HELD) -> PlantModel:
        """Return the model with the true payload and the flexible parts of ``model.flexible``,
        whose coordinates are in q and v (``PlantModel.split``); see ``nominal``.
        """
        return self._model("flexible", grip)

    def _model(self, kind: str, grip: Grip) -> PlantModel:
        key = kind, grip.holds
        if key not in self._made:
            is_flexible = kind == "flexible"
            plant = self.whole if is_flexible else self.rigid
            context = plant.CreateDefaultContext()
            self._set_masses(plant, context, grip, nominal=kind == "nominal")
            if is_flexible:
                self._set_springs(plant, context)
            self._made[key] = PlantModel(
                plant=plant,
                context=context,
                coordinates=self.coordinates,
                split=self.split if is_flexible else StateSplit(),
            )
        made = self._made[key]
        return dataclasses.replace(made, context=made.context.Clone(), grip=grip)

    def set_true_masses(self, plant: MultibodyPlant, context: Context, grip: Grip) -> None:
        """Set true masses and springs in a new context of a plant like ``whole``."""
        self._set_masses(plant, context, grip)
        self._set_springs(plant, context)

    def _set_masses(
        self, plant: MultibodyPlant, context: Context, grip: Grip, *, nominal: bool = False
    ) -> None:
        """Set payload, wheels, drives and the true geometry in a new context."""
        scenario, payload = self._scenario, grip.carried(self._scenario.payload)
        properties = payload.nominal if nominal else payload.truth
        # first: a rotor may be the only inertia that a joint moves
        set_drives(plant, context, scenario.drives, nominal=nominal)
        set_payload(plant, context, body=payload.body, properties=properties)
        set_wheels(plant, context, scenario.wheels)
        if not nominal and getattr(scenario.effects, "geometry", None):
            TRUE_GEOMETRY.only("effects.geometry")(plant, context, scenario)

    def change_payload(
        self, plant: MultibodyPlant, context: Context, properties: MassProperties
    ) -> None:
        """Set another true payload in one context whose other masses are set."""
        body = self._scenario.payload.body
        set_payload(plant, context, body=body, properties=properties)
        if self.model.flexible:
            flexible_parts().take_masses(plant, context, self.model, body=body)

    def loaded(self, model: PlantModel, properties: MassProperties) -> PlantModel:
        """Return a model with the other masses of the given one, and another true payload."""
        context = model.context.Clone()
        self.change_payload(model.plant, context, properties)
        return dataclasses.replace(model, context=context)

    def _set_springs(self, plant: MultibodyPlant, context: Context) -> None:
        if self.model.flexible:
            flexible_parts().set_flexible(plant, context, self.model)


def make_nominal_plant(scenario: Scenario, grip: Grip = HELD) -> PlantModel:
    """Return the model with the nominal payload (``payload.nominal``), as a controller uses it.

    Its mass matrix is Hhat. If you need more than one model of a scenario, ``Craft`` is faster.

    Args:
      scenario: the scenario.
      grip: what holds the target; if nothing does, the model has no payload.

    Raises:
      ModelError: the model cannot be loaded.

    Example:
      >>> from ffsm_drake import load_scenario, make_nominal_plant
      >>> make_nominal_plant(load_scenario("postcapture")).coordinates.joints
      ('joint_1', 'joint_2', 'joint_3', 'joint_4', 'joint_5')
    """
    return Craft(scenario).nominal(grip)


def make_true_plant(scenario: Scenario, grip: Grip = HELD) -> PlantModel:
    """Return the model with the true payload (``payload.truth``) and locked flexible parts.

    Args:
      scenario: the scenario.
      grip: what holds the target; if nothing does, the model has no payload.

    Raises:
      ModelError: the model cannot be loaded.

    Example:
      >>> import numpy as np
      >>> from ffsm_drake import load_scenario, make_true_plant
      >>> model = make_true_plant(load_scenario("postcapture"))
      >>> q = np.array([1.0, *np.zeros(11)])
      >>> round(float(model.calc_mass_matrix(q)[3, 3]), 6)  # kg, base, arm and target
      526.0
    """
    return Craft(scenario).true(grip)
