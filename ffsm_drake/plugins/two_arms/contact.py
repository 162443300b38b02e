"""Contacts that close a loop: their force on the plant, and its internal part."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import Adder, ConstantVectorSource, Gain

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import short
from ffsm_drake.loop import blocks
from ffsm_drake.plugins.two_arms.flow import GAP, WRENCHES, ContactFlow, contact_flow
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.scenario.contacts import ALL_HANDS, WRENCH, Contact, closing_contacts
from ffsm_drake.spacecraft.coordinates import Coordinates, halves
from ffsm_drake.spacecraft.grasp import plastic_impact
from ffsm_drake.spacecraft.limits import Limit
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.continuous import InstantSystem
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import INTERNAL_WORK, Signal, View
from ffsm_drake.systems.sensing.noise import Noise
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock

CLOSING, LOSS = "contact_closing", "contact_loss"  # where late hands grasp
_CLOSING = {
    "linear_impulse": "N s",
    "angular_impulse": "N m s",
    "linear_momentum_change": "N s",
    "angular_momentum_change": "N m s",
    "angle": "rad",
    "distance": "m",
    "rate": "rad/s",
    "speed": "m/s",
}
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

    @classmethod
    def of(cls, scenario: Scenario) -> "Contacts":
        """The contacts that close a loop."""
        return cls(contacts=closing_contacts(scenario, ALL_HANDS))

    def held_by(self, grip: Grip) -> "Contacts | None":
        """The contacts that close a loop in a phase; None without any."""
        contacts = {name: each for name, each in self.contacts.items() if grip.closes(each)}
        return Contacts(contacts=contacts) if contacts else None

    def build(self, setup: BlockSetup) -> "ContactForce":
        """The force of the contacts."""
        return ContactForce(setup)

    def flow(self, setup: BlockSetup) -> ContactFlow | None:
        """The force for compiled runs. None: they do not cover flexible parts, springs, noise and
        hands that close later.
        """
        is_plain = all(
            each.kind == "rigid" and not (each.closes or each.moment_noise or each.force_noise)
            for each in closing_contacts(setup.scenario, setup.grip).values()
        )
        return contact_flow(setup) if is_plain and not setup.scenario.model.flexible else None

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Wrench on the target and gap of each contact."""
        names, units = self._components, self._units
        late = (
            Signal(
                name=CLOSING,
                unit="see component",
                meaning="latest contact: size of the impulse of the hand on the target, of the "
                "change of total momentum, and of the miss before it; 0: no contact yet",
                components=tuple(_CLOSING),
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
        )

    def limits(self, coordinates: Coordinates) -> Sequence[Limit]:
        """The limits of the wrenches."""
        given = [
            each for one in self.contacts.values() for each in (one.moment_limit, one.force_limit)
        ]
        if not any(given):
            return ()
        bound = np.repeat([np.inf if each is None else each for each in given], 3)
        names = self._components
        return [
            Limit(
                quantity=WRENCHES,
                source="the limits of the contacts",
                names=names,
                units=tuple(self._units.values()),
                upper=bound,
                lower=-bound,
            )
        ]

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
        )

    @property
    def _is_late(self) -> bool:
        return any(each.closes for each in self.contacts.values())

    @staticmethod
    def _of_closings() -> Iterator[Metric]:
        """Largest figures over the closings of late hands, and the energy lost in all of them."""
        for k, (name, unit) in enumerate(_CLOSING.items()):
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
        return {name: "N" if "force" in name else "N m" for name in self._components}


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

    Inputs: ``state`` (nq + nv), ``hidden_state``, ``other_force`` (nv). Outputs:
    ``generalized_force`` (nv), ``contact_wrench`` (on the target), ``contact_gap`` and
    ``measured_wrench`` (the wrench with the noise of the wrists' sensors; 6 for each contact).
    """

    def __init__(self, setup: BlockSetup) -> None:
        period, contacts = setup.sample_time, closing_contacts(setup.scenario, setup.grip)
        flow = contact_flow(setup)
        _check_step(setup.scenario, flow, contacts)
        made: dict[str, ConstantVectorSource] = {}
        if any(each.closes for each in contacts.values()):
            made[CLOSING] = ConstantVectorSource(np.zeros(len(_CLOSING)))
            made[LOSS] = ConstantVectorSource(np.zeros(1))
        contact = InstantSystem(flow, name="contact", sample_time=period)
        systems: dict[str, System] = {"contact": contact, **made}
        signals = {name: {"y0": name} for name in made}
        noise = np.repeat([[each.moment_noise, each.force_noise] for each in contacts.values()], 3)
        if noise.any():
            systems["noise"] = Noise("noise", Gain(noise), sample_time=period)
            systems["noisy"] = Adder(2, noise.size)
            signals["noisy"] = {"u0": blocks.WRENCH, "u1": "noise", "sum": blocks.WRENCH}
        shown = (*flow.outputs, *made)
        super().__init__("contacts", systems, inputs=flow.inputs, outputs=shown, signals=signals)
        self._flow, self._contact, self._made = flow, contact, made

    def beyond(self, state: np.ndarray, envelope: Envelope) -> str:
        """The part of a hand's miss beyond an envelope, in words, at the plant's own [q; v]; empty
        where it holds.
        """
        angle, distance, rate, speed = self._miss(state).values()
        return envelope.beyond(
            position=distance, angle=angle, velocity=speed, angular_velocity=rate
        )

    def hold(self, state: np.ndarray) -> None:
        """Hold the hands where they are at the plant's own [q; v]."""
        q, model = halves(state)[0], self._flow.model
        closures = tuple(each.met(model, q) for each in self._flow.closures)
        self._contact.exchange(dataclasses.replace(self._flow, closures=closures))

    def close(self, context: Context, state: np.ndarray, *, work: float) -> np.ndarray:
        """The plant's own [q; v] after late hands have closed where they are; rigid ones by a
        plastic impact.

        Args: the system's context; the state before; work of the closings before, J.
        """
        self.hold(state)
        flow = self._contact.block_at(self.GetSubsystemContext(self._contact, context))
        (q, v), model, multipliers = halves(state), flow.model, np.zeros(flow.gains.shape[1])
        rows, H = flow.jacobian(q)[flow.rigid], model.calc_mass_matrix(q)
        after, multipliers[flow.rigid] = plastic_impact(H, rows, v)
        momenta = list[np.ndarray]()
        for each in (v, after):
            model.plant.SetVelocities(model.context, each)
            momentum = model.plant.CalcSpatialMomentumInWorldAboutPoint(model.context, np.zeros(3))
            momenta.append(momentum.get_coeffs())
        ledger = self._miss(state)
        for kind, wrench in (
            ("impulse", flow.wrench(multipliers)),
            ("momentum_change", momenta[1] - momenta[0]),
        ):
            angular, linear = _largest_of(wrench)
            ledger |= {f"angular_{kind}": angular, f"linear_{kind}": linear}
        loss = 0.5 * float((v - after) @ H @ (v + after))
        values = {CLOSING: [ledger[name] for name in _CLOSING], LOSS: [work - loss]}
        for name, source in self._made.items():
            own = self.GetMutableSubsystemContext(source, context)
            source.get_mutable_source_value(own).set_value(np.array(values[name]))
        return np.concatenate([q, after])

    def _miss(self, state: np.ndarray) -> dict[str, float]:
        """The largest distance of a hand from its place, and its motion there, at the plant's own
        [q; v]: ``angle`` (rad), ``distance`` (m), ``rate`` (rad/s), ``speed`` (m/s).
        """
        (q, v), flow = halves(state), self._flow  # not where an earlier run has closed
        gap, rate = flow.wrench(flow.gap(q)), flow.wrench(flow.jacobian(q) @ v)
        sizes = (*_largest_of(gap), *_largest_of(rate))
        return dict(zip(("angle", "distance", "rate", "speed"), sizes, strict=True))


def _largest_of(pairs: np.ndarray) -> list[float]:
    """The largest sizes of the first and of the second vectors (3) of pairs (6 each)."""
    found: list[float] = np.linalg.norm(pairs.reshape(-1, 2, 3), axis=2).max(axis=0).tolist()
    return found


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
