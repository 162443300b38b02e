"""Contacts that close a loop: their force on the plant, and its internal part."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Demultiplexer,
    Gain,
    RandomSource,
)
from scipy.linalg import block_diag
from scipy.linalg.lapack import dposv

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.numbers import short
from ffsm_drake.loop import blocks
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.plugins.two_arms.flow import ContactFlow, contact_flow
from ffsm_drake.scenario import Grip, MassProperties, Scenario
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.scenario.contacts import ALL_HANDS, WRENCH, Contact, closing_contacts
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import Limit
from ffsm_drake.spacecraft.nominal import change_payload, damping_of, make_flexible_plant
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.part import INTERNAL_WORK, Metric, Part, Signal, View
from ffsm_drake.systems.setup import BlockSetup

WRENCHES, GAP = "contact_wrench", "contact_gap"
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
# miss of a hand -> its bound, a key of ``capture.envelope``, and its unit
_BOUNDS = {
    "distance": ("position", "m"),
    "angle": ("angle", "rad"),
    "speed": ("velocity", "m/s"),
    "rate": ("angular_velocity", "rad/s"),
}
_ORIGIN = np.zeros(3)


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

    def build(self, setup: BlockSetup) -> LeafSystem:
        """The force of the contacts."""
        return ContactForce(setup)

    def flow(self, setup: BlockSetup) -> ContactFlow | None:
        """The force as pure functions; None: they do not cover it."""
        return contact_flow(setup)

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


class ContactForce(Diagram):
    """The force of the contacts, which close loops of the plant's tree.

    Inputs: ``state`` (nq + nv), ``hidden_state``, ``other_force`` (nv). Outputs:
    ``generalized_force`` (nv), ``contact_wrench`` (on the target), ``contact_gap`` and
    ``measured_wrench`` (the wrench with the noise of the wrists' sensors; 6 for each contact).
    """

    def __init__(self, setup: BlockSetup) -> None:
        super().__init__()
        builder = DiagramBuilder()
        self._contact = builder.AddSystem(_Contact(setup))
        for index in range(self._contact.num_input_ports()):
            port = self._contact.get_input_port(index)
            builder.ExportInput(port, port.get_name())
        acting, gap = map(self._contact.get_output_port, range(2))
        size = gap.size()
        parts = builder.AddSystem(Demultiplexer([len(setup.coordinates.names), size]))
        builder.Connect(acting, parts.get_input_port())
        for index, name in enumerate(("generalized_force", WRENCHES)):
            builder.ExportOutput(parts.get_output_port(index), name)
        builder.ExportOutput(gap, GAP)
        self._made = list[ConstantVectorSource]()
        if any(each.closes for each in self._contact.contacts):
            for name, values in ((CLOSING, np.zeros(len(_CLOSING))), (LOSS, np.zeros(1))):
                self._made.append(builder.AddSystem(ConstantVectorSource(values)))
                builder.ExportOutput(self._made[-1].get_output_port(), name)
        measured, noise = parts.get_output_port(1), _noise(self._contact.contacts)
        if noise.any():
            period = setup.scenario.sample_time
            samples = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, size, period))
            shaped, noisy = builder.AddSystem(Gain(noise)), builder.AddSystem(Adder(2, size))
            builder.Connect(samples.get_output_port(), shaped.get_input_port())
            builder.Connect(shaped.get_output_port(), noisy.get_input_port(1))
            builder.Connect(measured, noisy.get_input_port(0))
            measured = noisy.get_output_port()
        builder.ExportOutput(measured, blocks.WRENCH)
        builder.BuildInto(self)

    def set_payload(self, context: Context, properties: MassProperties) -> None:
        """Give the payload other mass properties."""
        self._contact.set_payload(properties)

    def beyond(self, state: np.ndarray, envelope: Envelope) -> str:
        """The part of a hand's miss beyond an envelope, in words, at the plant's own [q; v]; empty
        where it holds.
        """
        miss = self._contact.miss(state)
        bounds = {name: getattr(envelope, bound) for name, (bound, _) in _BOUNDS.items()}
        return ", ".join(
            f"{key} {miss[name]:.3g} {unit} (capture.envelope.{key}: {bounds[name]:g})"
            for name, (key, unit) in _BOUNDS.items()
            if bounds[name] is not None and not miss[name] <= bounds[name]
        )

    def hold(self, state: np.ndarray) -> None:
        """Hold the hands where they are at the plant's own [q; v]."""
        self._contact.hold(state)

    def close(self, context: Context, state: np.ndarray, *, work: float) -> np.ndarray:
        """The plant's own [q; v] after late hands have closed where they are; rigid ones by a
        plastic impact.

        Args: the system's context; the state before; work of the closings before, J.
        """
        after, ledger = self._contact.close(state)
        for source, values in zip(
            self._made, ([ledger[name] for name in _CLOSING], [work - ledger["loss"]]), strict=True
        ):
            own = self.GetMutableSubsystemContext(source, context)
            source.get_mutable_source_value(own).set_value(np.array(values))
        return after


def _noise(contacts: Sequence[Contact]) -> np.ndarray:
    """Standard deviations of the wrenches' noise (6 for each contact)."""
    return np.repeat([[each.moment_noise, each.force_noise] for each in contacts], 3)


class _Contact(LeafSystem):
    """Force and wrenches in one output: with two, Drake would call it twice.

    A rigid contact holds A v = 0: its multipliers solve A H^-1 (f + A' lambda) = -(dA/dt v + c), f
    being all other forces. The correction c (state) of a sample is k_1 gap + k_2 A v at its
    beginning; both decay with exp(-w t), w being its ``stabilization``. A correction of each stage
    would take the stages' own gaps, O(h^2), for errors. A compliant contact gives lambda = -(K gap
    + D A v).
    """

    def __init__(self, setup: BlockSetup) -> None:
        super().__init__()
        self._scenario, grip = setup.scenario, setup.grip
        self._model = make_flexible_plant(setup.scenario, grip)
        coordinates, split = setup.coordinates, self._model.split
        plant = self._model.plant
        self._chain = ClosedChain(plant, setup.scenario, grip, true=True)
        self.contacts = [loop.contact for loop in self._chain.loops]
        self._places = self._chain.loops
        nv, nq = len(coordinates.names), len(coordinates.position_names)
        self._split, self._known = split, split.known if split.names else None
        loss = damping_of(plant)
        self._loss = loss if loss.any() else None
        # the last state with what follows from it: a period begins with the state at the end of
        # the one before
        self._kept: tuple[bytes, Any] = b"", None
        self._set_gains()
        self._check_step()
        self._state = self.DeclareVectorInputPort("state", nq + nv)
        self._other = self.DeclareVectorInputPort("other_force", nv)
        hidden = 2 * len(split.names)
        self._hidden = self.DeclareVectorInputPort("hidden_state", hidden) if hidden else None
        size = 6 * len(self._chain.loops)
        self._nv, self._values = nv, np.empty(nv + size)
        self.DeclareVectorOutputPort("acting", nv + size, weak_callback(self._calc))
        # at the state alone: read between two stages
        states = {self.input_port_ticket(self._state.get_index())}
        if self._hidden is not None:
            states.add(self.input_port_ticket(self._hidden.get_index()))
        self.DeclareVectorOutputPort(
            "gap", size, weak_callback(self._calc_gap), prerequisites_of_calc=states
        )
        self.DeclareDiscreteState(self._rigid.size)
        self.DeclarePeriodicDiscreteUpdateEvent(
            setup.scenario.sample_time, 0.0, weak_callback(self._correct)
        )
        untie(self)

    def _set_gains(self) -> None:
        """Rates (m) of rigid contacts, stiffness and damping (m, m) of compliant ones."""
        loops = self._chain.loops
        rows = [len(loop.rows) for loop in loops]
        h = self._scenario.sample_time
        w = np.repeat([loop.contact.stabilization for loop in loops], rows)
        p = np.exp(-w * h)  # both poles of x'' = -(k_1 x + k_2 x'), held for h
        self._k = ((1.0 - p) / h) ** 2, (1.0 - p) * (3.0 + p) / (2.0 * h)
        compliant = np.repeat([loop.contact.kind == "compliant" for loop in loops], rows)
        self._rigid, self._soft = np.flatnonzero(~compliant), np.flatnonzero(compliant)
        self._stiffness, self._damping = (
            block_diag(*(loop.rows @ np.diag(gains(loop.contact)) @ loop.rows.T for loop in loops))
            for gains in (_stiffness, _damping)
        )

    def _check_step(self) -> None:
        """Raise ScenarioError for springs too fast for steps of Runge-Kutta's third order."""
        config, plant = self._scenario.simulator_config, self._model.plant
        if not self._soft.size or config.integration_scheme != "runge_kutta3":
            return
        posture = configuration(plant, self._scenario.initial_posture, key="initial_posture")
        plant.SetPositions(self._model.context, posture)
        A, H = self._chain.jacobian(self._model.context), plant.CalcMassMatrix(self._model.context)
        inner = A @ np.linalg.solve(H, A.T)
        zero, one = np.zeros_like(inner), np.eye(len(inner))
        poles = np.linalg.eigvals(
            np.block([[zero, one], [-inner @ self._stiffness, -inner @ self._damping]])
        )[:, None]
        steps = config.max_step_size * 0.5 ** np.arange(30)
        z = steps * poles[np.abs(poles[:, 0]) > 1e-6]
        growth = np.abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0))).max(axis=0)
        if growth[0] > 1.0:
            loop = next(each for each in self._chain.loops if each.contact.kind == "compliant")
            raise ScenarioError(
                f"contacts.{loop.name}.kind",
                f"its spring vibrates at up to {short(np.abs(poles).max())} rad/s, too fast for "
                f"steps of {config.max_step_size:g} s; set simulator_config.max_step_size to "
                f"{steps[np.argmax(growth <= 1.0)]:.3g}",
            )

    def set_payload(self, properties: MassProperties) -> None:
        """Give the payload other mass properties."""
        change_payload(self._model.plant, self._model.context, self._scenario, properties)
        self._kept = b"", None

    def miss(self, state: np.ndarray) -> dict[str, float]:
        """The largest distance of a hand from its place, and its motion there, at the plant's own
        [q; v]: ``angle`` (rad), ``distance`` (m), ``rate`` (rad/s), ``speed`` (m/s).
        """
        plant, own, chain = self._model.plant, self._model.context, self._chain
        plant.SetPositionsAndVelocities(own, state)
        held, chain.loops = chain.loops, self._places  # not where an earlier run has closed
        sizes = [
            np.linalg.norm((chain.wrench_map @ each).reshape(-1, 3), axis=1).reshape(-1, 2)
            for each in (chain.gap(own), chain.jacobian(own) @ state[plant.num_positions() :])
        ]
        chain.loops = held
        largest = np.concatenate([each.max(axis=0) for each in sizes]).tolist()
        return dict(zip(("angle", "distance", "rate", "speed"), largest, strict=True))

    def hold(self, state: np.ndarray) -> None:
        """See ``ContactForce``."""
        self._model.plant.SetPositionsAndVelocities(self._model.context, state)
        self._chain.meet(self._model.context)
        self._kept = b"", None

    def close(self, state: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
        """See ``ContactForce``; ledger of ``_CLOSING``, and the energy lost, J."""
        ledger = self.miss(state)  # sets the state
        plant, own, chain = self._model.plant, self._model.context, self._chain
        self.hold(state)
        q, v = np.split(state, [plant.num_positions()])
        rows, H = chain.jacobian(own)[self._rigid], plant.CalcMassMatrix(own)
        inverse, multipliers = np.linalg.solve(H, rows.T), np.zeros(chain.size)
        multipliers[self._rigid] = np.linalg.solve(rows @ inverse, -rows @ v)
        after = v + inverse @ multipliers[self._rigid]
        momenta = list[np.ndarray]()
        for each in (v, after):
            plant.SetVelocities(own, each)
            momenta.append(plant.CalcSpatialMomentumInWorldAboutPoint(own, _ORIGIN).get_coeffs())
        sizes = np.linalg.norm(self._wrench(multipliers).reshape(-1, 3), axis=1).reshape(-1, 2)
        change = np.linalg.norm((momenta[1] - momenta[0]).reshape(2, 3), axis=1).tolist()
        ledger |= {"angular_impulse": sizes[:, 0].max(), "linear_impulse": sizes[:, 1].max()}
        ledger |= {"angular_momentum_change": change[0], "linear_momentum_change": change[1]}
        ledger["loss"] = 0.5 * float((v - after) @ H @ (v + after))
        return np.concatenate([q, after]), ledger

    def _whole(self, context: Context) -> np.ndarray:
        """The plant's own [q; v]."""
        state: np.ndarray = self._state.Eval(context)
        return (
            state if self._hidden is None else self._split.whole(state, self._hidden.Eval(context))
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        state, force = self._whole(context), self._other.Eval(context)
        if self._hidden is not None:
            force = self._split.whole_velocities(force)
        found = self._found(state)
        multipliers = found.soft
        if found.inner is not None:
            correction = context.get_discrete_state_vector().value()
            multipliers = self._rigid_ones(found, state, force, correction)
        acts, values = multipliers @ found.jacobian, self._values
        values[: self._nv] = acts if self._known is None else acts[self._known]
        values[self._nv :] = -self._wrench(multipliers)  # on the target
        output.SetFromVector(values)

    def _calc_gap(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._wrench(self._gap(self._whole(context))))

    def _correct(self, context: Context, after: DiscreteValues) -> None:
        state = self._whole(context)
        rate = self._found(state).jacobian @ state[self._model.plant.num_positions() :]
        found = self._k[0] * self._gap(state) + self._k[1] * rate
        after.set_value(found[self._rigid])

    def _gap(self, state: np.ndarray) -> np.ndarray:
        """The gap (m) at the plant's state [q; v]; read twice where a period ends."""
        kept = self._found(state).gap
        if not kept:
            self._model.plant.SetPositionsAndVelocities(self._model.context, state)
            kept.append(self._chain.gap(self._model.context))
        return kept[0]

    def _found(self, state: np.ndarray) -> "_Geometry":
        if (content := state.tobytes()) != self._kept[0]:
            self._kept = content, self._geometry(state)
        found: _Geometry = self._kept[1]
        return found

    def _rigid_ones(
        self, found: "_Geometry", state: np.ndarray, force: np.ndarray, correction: np.ndarray
    ) -> np.ndarray:
        """The multipliers (m) with those of rigid contacts, under all other forces (nv)."""
        force = force + found.given
        if self._known is not None:  # with the springs of flexible parts
            plant, own = self._model.plant, self._model.context
            plant.SetPositionsAndVelocities(own, state)
            plant.get_applied_generalized_force_input_port().FixValue(own, force)
            acceleration = plant.get_generalized_acceleration_output_port().Eval(own)
            force = plant.CalcMassMatrix(own) @ acceleration
        wanted = found.wanted - correction
        _, rigid, failed = dposv(found.inner, wanted - force @ found.inverse)
        if failed:  # a singular posture
            rigid = np.full(rigid.size, np.nan)
        if not self._soft.size:
            return rigid
        multipliers = found.soft.copy()
        multipliers[self._rigid] = rigid
        return multipliers

    def _wrench(self, along: np.ndarray) -> np.ndarray:
        """(6 for each contact) from what is along the constraints (m)."""
        chain = self._chain
        return along if chain.is_spatial else chain.wrench_map @ along

    def _geometry(self, state: np.ndarray) -> "_Geometry":
        """Everything that depends on the plant's state [q; v] alone."""
        plant, own, chain = self._model.plant, self._model.context, self._chain
        plant.SetPositionsAndVelocities(own, state)
        v = state[plant.num_positions() :]
        jacobian = chain.jacobian(own)
        soft = None
        if self._known is not None:
            given = np.zeros(v.size)
        else:
            given = -plant.CalcBiasTerm(own)
            if self._loss is not None:
                given -= self._loss * v
        if self._soft.size:
            soft = -(self._stiffness @ chain.gap(own) + self._damping @ (jacobian @ v))
            soft[self._rigid] = 0.0
            given += soft @ jacobian
        if not self._rigid.size:
            return _Geometry(jacobian, [], soft, given)
        wanted, rows = chain.bias(own), jacobian
        if self._soft.size:
            rows, wanted = jacobian[self._rigid], wanted[self._rigid]
        _, inverse, _ = dposv(plant.CalcMassMatrix(own), rows.T)  # H^-1 A'
        return _Geometry(jacobian, [], soft, given, rows @ inverse, inverse, -wanted)


class _Geometry(NamedTuple):
    """The contacts' quantities that depend on the plant's state alone."""

    jacobian: np.ndarray  # A (m, nv)
    gap: list[np.ndarray]  # (m), once it has been read
    soft: Any  # (m) multipliers of compliant contacts; None: there are none
    given: np.ndarray  # (nv) known forces: of compliant contacts, bias and damping
    inner: Any = None  # A H^-1 A' (r, r) of the rigid contacts; None: there are none
    inverse: Any = None  # H^-1 A' (nv, r)
    wanted: Any = None  # (r) A dv/dt, without the correction


def _stiffness(contact: Contact) -> list[float]:
    return [contact.rotational_stiffness] * 3 + [contact.stiffness] * 3


def _damping(contact: Contact) -> list[float]:
    return [contact.rotational_damping] * 3 + [contact.damping] * 3
