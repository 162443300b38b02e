"""Contacts that close a loop: their force on the plant, and its internal part."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydrake.systems.framework import System
from pydrake.systems.primitives import Adder, Gain

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import short
from ffsm_drake.loop import blocks
from ffsm_drake.plugins.two_arms.borne import used_friction, weld_wrench
from ffsm_drake.plugins.two_arms.flow import (
    CLOSING,
    CLOSING_UNITS,
    FRICTION,
    GAP,
    LOSS,
    WELD,
    WRENCHES,
    ContactFlow,
    contact_flow,
)
from ffsm_drake.plugins.two_arms.loads import is_judged
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.scenario.contacts import ALL_HANDS, WRENCH, Contact, closing_contacts
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import Limit
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.continuous import InstantSystem
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import INTERNAL_WORK, Signal, View
from ffsm_drake.systems.sensing.noise import Noise
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock

_FIGURES = {
    "linear_impulse": "impulse",
    "angular_impulse": "angular impulse",
    "angle": "angular miss",
    "distance": "miss",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contacts(Part):
    """The section ``contacts``, beside the weld of the model."""

    title, section = "Contacts", "Contacts"
    about = (
        "The wrench on the target at each contact other than the weld of the model, in the axes of "
    )
    about += "the contact's frame on the target."
    contacts: Mapping[str, Contact] = dataclasses.field(default_factory=dict)
    every: Mapping[str, Contact] = dataclasses.field(default_factory=dict)  # with the weld

    @classmethod
    def of(cls, scenario: Scenario) -> "Contacts":
        """The contacts that close a loop."""
        return cls(contacts=closing_contacts(scenario, ALL_HANDS), every=scenario.contacts)

    def held_by(self, grip: Grip) -> "Contacts | None":
        """The contacts that close a loop in a phase; None without any."""
        contacts = {name: each for name, each in self.contacts.items() if grip.closes(each)}
        return dataclasses.replace(self, contacts=contacts) if contacts else None

    def build(self, setup: BlockSetup) -> "ContactForce":
        """The force of the contacts."""
        return ContactForce(setup)

    def flow(self, setup: BlockSetup) -> ContactFlow | None:
        """The force for compiled runs; None with noise."""
        contacts = closing_contacts(setup.scenario, setup.grip).values()
        is_noisy = any(each.moment_noise or each.force_noise for each in contacts)
        return None if is_noisy else contact_flow(setup)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Wrench on the target and gap of each contact."""
        names, units = self._components, self._units
        late = (
            Signal(
                name=CLOSING,
                unit="see component",
                meaning="latest contact: size of the impulse of the hand on the target, of the "
                "change of total momentum, and of the miss before it; 0: no contact yet",
                components=tuple(CLOSING_UNITS),
                held=False,
                heading="",
            ),
            Signal(
                name=LOSS,
                unit="J",
                meaning="work of the closings since the start",
                held=False,
                role=INTERNAL_WORK,
                heading="",
            ),
        )
        return (
            Signal(
                name=WRENCHES,
                unit="N m or N",
                meaning="moment and force of the hand on the target at each contact, in the axes "
                "of the contact's frame, before this sample's control acts",
                components=names,
                held=False,
                panels=units,
                heading="Wrench at the contacts",
            ),
            Signal(
                name=GAP,
                unit="rad or m",
                meaning="rotation and position of the hand from where the contact holds it",
                components=tuple(
                    name.replace("moment", "rotation").replace("force", "position")
                    for name in names
                ),
                held=False,
                heading="",
            ),
            *(late if self._is_late else ()),
            *self._of_load(),
        )

    def _of_load(self) -> Iterator[Signal]:
        """Wrench of the welded hand, if it has limits, and the used friction."""
        if self._weld:
            yield Signal(
                name=WELD,
                unit="N m or N",
                meaning="moment and force of the welded hand on the target, in the axes of its "
                "frame, mean of the sample before",
                components=WRENCH,
                held=False,
                of=weld_wrench,
                panels={name: _unit_of(name) for name in WRENCH},
                heading="Wrench of the welded hand",
            )
        if self._slipping:
            yield Signal(
                name=FRICTION,
                unit="1",
                meaning="used share of the friction of a hand: it slips above 1",
                components=tuple(self._slipping),
                held=False,
                of=used_friction,
                heading="Used friction",
            )

    @property
    def _weld(self) -> Mapping[str, Contact]:
        """The welded contact, if it has a limit or friction."""
        return {
            name: each
            for name, each in self.every.items()
            if name not in self.contacts and not each.closes and is_judged(each)
        }

    @property
    def _slipping(self) -> Sequence[str]:
        return [name for name, each in self.every.items() if each.friction is not None]

    def limits(self, coordinates: Coordinates) -> Sequence[Limit]:
        """The limits of the wrenches, and of the friction."""
        found = [*_limit(WRENCHES, self.contacts), *_limit(WELD, self._weld)]
        if self._slipping:
            one = np.ones(len(self._slipping))
            keys = " or ".join(f"contacts.{name}.friction" for name in self._slipping)
            found.append(
                Limit(
                    quantity=FRICTION,
                    source=f"{keys}, so the hand slips",
                    names=tuple(self._slipping),
                    units=("times its friction",) * one.size,
                    upper=one,
                    lower=-one,
                    fails="slips",
                )
            )
        return found

    def metrics(self) -> Sequence[Metric]:
        """Largest internal force and moment, over the run and over its last second; the gap."""
        return (
            Metric(
                key="contacts.force",
                unit="N",
                label="Largest force at the contacts",
                ranked=True,
                of=lambda run: np.nanmax(_sizes(run)[..., 1]),
            ),
            Metric(
                key="contacts.moment",
                unit="N m",
                label="Largest moment at the contacts",
                ranked=True,
                of=lambda run: np.nanmax(_sizes(run)[..., 0]),
            ),
            Metric(
                key="contacts.force_at_end",
                unit="N",
                label="Largest force in the last second",
                of=lambda run: _sizes(run)[_last(run) :, :, 1].max(),
            ),
            Metric(
                key="contacts.moment_at_end",
                unit="N m",
                label="Largest moment in the last second",
                of=lambda run: _sizes(run)[_last(run) :, :, 0].max(),
            ),
            Metric(
                key="contacts.gap",
                unit="rad or m",
                label="Largest gap of the contacts",
                of=lambda run: np.nanmax(np.abs(run[GAP])),
            ),
            *(self._of_closings() if self._is_late else ()),
            *(self._of_friction() if self._slipping else ()),
        )

    @staticmethod
    def _of_friction() -> Iterator[Metric]:
        """The largest used share of the friction of a hand."""
        yield Metric(
            key="contacts.friction",
            unit="1",
            label="Largest used friction",
            ranked=True,
            of=lambda run: np.nanmax(run[FRICTION], initial=0.0),
        )

    @property
    def _is_late(self) -> bool:
        return any(each.closes for each in self.contacts.values())

    @staticmethod
    def _of_closings() -> Iterator[Metric]:
        """Largest figures over the closings of late hands, and the energy lost in all of them."""
        for k, (name, unit) in enumerate(CLOSING_UNITS.items()):
            if name in _FIGURES:
                yield Metric(
                    key=f"contacts.closing.{name}",
                    unit=unit,
                    label=f"Largest {_FIGURES[name]} at a closing",
                    of=functools.partial(_largest, k),
                )
        yield Metric(
            key="contacts.closing.energy_lost",
            unit="J",
            label="Energy lost at closings",
            of=lambda run: 0.0 - run[LOSS][-1],
        )

    @property
    def _components(self) -> tuple[str, ...]:
        if len(self.contacts) == 1:
            return WRENCH
        return tuple(f"{name}_{axis}" for name in self.contacts for axis in WRENCH)

    @property
    def _units(self) -> dict[str, str]:
        return {name: _unit_of(name) for name in self._components}


def _unit_of(name: str) -> str:
    return "N" if "force" in name else "N m"


def _limit(quantity: str, contacts: Mapping[str, Contact]) -> Iterator[Limit]:
    """The limit of the wrenches of contacts, if one is given."""
    given = {
        f"contacts.{name}.{key}": getattr(contact, key)
        for name, contact in contacts.items()
        for key in ("moment_limit", "force_limit")
    }
    names = tuple(f"{name}_{axis}" for name in contacts for axis in WRENCH)
    if any(given.values()):
        bound = np.repeat([np.inf if each is None else each for each in given.values()], 3)
        yield Limit(
            quantity=quantity,
            source=" or ".join(key for key, each in given.items() if each),
            names=names,
            units=tuple(map(_unit_of, names)),
            upper=bound,
            lower=-bound,
        )


def _largest(component: int, run: View) -> float:
    """The largest of a component of ``contact_closing``."""
    return float(run[CLOSING][:, component].max())


def _sizes(run: View) -> np.ndarray:
    """Sizes of moment and force (n, contacts, 2), N m and N."""
    wrench = run[WRENCHES]
    sizes: np.ndarray = np.linalg.norm(wrench.reshape(len(wrench), -1, 2, 3), axis=-1)
    return sizes


def _last(run: View) -> int:
    """The sample at which the last second begins."""
    return max(0, len(run.time) - 1 - round(1.0 / run.scenario.sample_time))


class ContactForce(CompositeBlock):
    """The force of the contacts, which close loops of the plant's tree.

    Inputs: ``state`` (nq + nv), ``hidden_state``, ``other_force`` (plant's nv). Outputs:
    ``generalized_force`` (nv), ``contact_wrench`` (on the target), ``contact_gap`` and
    ``measured_wrench`` (the wrench with the noise of the wrists' sensors; 6 for each contact).
    """

    def __init__(self, setup: BlockSetup) -> None:
        period, contacts = setup.sample_time, closing_contacts(setup.scenario, setup.grip)
        flow = contact_flow(setup)
        _check_step(setup.scenario, flow, contacts)
        contact = InstantSystem(flow, name="contact", sample_time=period)
        systems: dict[str, System] = {"contact": contact}
        signals = dict[str, dict[str, str]]()
        noise = np.repeat([[each.moment_noise, each.force_noise] for each in contacts.values()], 3)
        if noise.any():
            systems["noise"] = Noise("noise", Gain(noise), sample_time=period)
            systems["noisy"] = Adder(2, noise.size)
            signals["noisy"] = {"u0": blocks.WRENCH, "u1": "noise", "sum": blocks.WRENCH}
        shown = flow.outputs
        super().__init__("contacts", systems, inputs=flow.inputs, outputs=shown, signals=signals)
        self._flow, self._contact = flow, contact

    @property
    def block(self) -> ContactFlow:
        """The force, with the payload that the scenario carries then."""
        return self._flow

    def exchange(self, block: ContactFlow) -> None:
        """Let another force act. The block stays."""
        self._contact.exchange(block)


def _check_step(scenario: Scenario, flow: ContactFlow, contacts: Mapping[str, Contact]) -> None:
    """Raise ScenarioError for springs too fast for steps of Runge-Kutta's third order."""
    config, model = scenario.simulator_config, flow.model
    if not flow.soft.size or config.integration_scheme != "runge_kutta3":
        return
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    A = flow.jacobian(q)
    inner = (A @ np.linalg.solve(model.calc_mass_matrix(q), A.T))[:, flow.soft]
    zero, one = np.zeros((len(A), len(A))), np.eye(len(A))
    poles = np.linalg.eigvals(
        np.block([[zero, one], [-inner @ flow.stiffness, -inner @ flow.damping]])
    )[:, None]
    steps = config.max_step_size * 0.5 ** np.arange(30)
    z = steps * poles[np.abs(poles[:, 0]) > 1e-6]
    growth = np.abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0))).max(axis=0)
    if growth[0] > 1.0:
        name = next(name for name, each in contacts.items() if each.kind == "compliant")
        raise ScenarioError(
            f"contacts.{name}.kind",
            f"its spring vibrates at up to {short(np.abs(poles).max())} rad/s, too fast for "
            f"steps of {config.max_step_size:g} s; set simulator_config.max_step_size to "
            f"{steps[np.argmax(growth <= 1.0)]:.3g}",
        )
