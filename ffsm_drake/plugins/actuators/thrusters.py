"""Thrusters: from the base's commanded wrench to the one that on/off thrusters fire."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ffsm_drake.common.choice import may_be
from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.numbers import counted, percent, short
from ffsm_drake.plugins.actuators.allocation import Allocation
from ffsm_drake.plugins.actuators.modulation import (
    SchmittTrigger,
    mean_level,
    pulse_widths,
    whole_frames,
)
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.plugins.actuators.thruster_faults import THRUSTER_FAULTS
from ffsm_drake.scenario import Scenario, Thruster, Thrusters, thrusters_of
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.parts.actuator import BaseActuator
from ffsm_drake.systems.parts.advice import Advice, Load
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.signals import TIMELINE, Constant, Signal, Signals, View, pulses_of
from ffsm_drake.systems.parts.solid import Solid
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup

_KEY = "actuation.thrusters"
STANDARD_GRAVITY = 9.80665  # m/s^2; defines the specific impulse
_WHOLE = 1.0 - 1e-9  # the part of a wrench that counts as all of it


class Firing(NamedTuple):
    """Output of thrusters in one control sample."""

    # (6) its mean on the base, torque then force in the base's axes; N m and N
    wrench: np.ndarray
    force: np.ndarray  # (n) mean force of each, N
    open_share: np.ndarray  # (n) share of the sample for which each is open
    # (1) the part of the commanded wrench that the last allocation could give, 0 to 1
    given: np.ndarray
    level: np.ndarray  # (n) the same force as a share of each thruster's, if it works


class ThrusterSet:
    """Allocation, modulation and thrust of a set of thrusters: pure functions of arrays."""

    def __init__(self, settings: Thrusters, *, sample_time: float) -> None:
        """Raises ScenarioError: with its failures the set cannot give every wrench."""
        units = thrusters_of(settings)
        self.names = tuple(units)
        self.settings, self.sample_time = settings, sample_time
        self.frame = settings.frame * sample_time
        self.force = np.array([unit.force for unit in units.values()])
        directions = np.array([unit.direction for unit in units.values()], dtype=float)
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        positions = np.array([unit.position for unit in units.values()], dtype=float)
        self.wrenches = np.vstack([np.cross(positions, directions).T, directions.T])
        failures = np.array([settings.failures.get(name, "") for name in units])
        self._works, self._stuck_on = failures == "", failures == "stuck_on"
        self._leak = self.wrenches[:, self._stuck_on] @ self.force[self._stuck_on]
        cost = 1.0 / np.array([unit.specific_impulse for unit in units.values()])
        self._allocation = self._make_allocation(cost)
        pwpf = settings.pwpf
        self._trigger = SchmittTrigger(
            gain=pwpf.gain,
            time_constant=pwpf.time_constant,
            on=pwpf.on,
            off=pwpf.off,
            sample_time=sample_time,
        )
        self._shortest = max(settings.minimum_on_time, sample_time)

    def _make_allocation(self, cost: np.ndarray) -> Allocation:
        """Among those that work. Raises ScenarioError as the constructor does."""
        works, settings, key = self._works, self.settings, f"{_KEY}.failures"
        try:
            allocation = Allocation(
                self.wrenches[:, works], largest=self.force[works], cost=cost[works]
            )
        except ValueError as error:
            without = ", ".join(f"{name} {failure}" for name, failure in settings.failures.items())
            problem = f"with {without} no thrusters give {error}"
            if not without:
                key = f"{_KEY}.{'units' if settings.layout is None else 'layout'}"
                problem = f"no thrusters give {error}; add some"
            raise ScenarioError(key, problem) from error
        if self._stuck_on.any() and allocation.solve(-self._leak)[1] < 1.0:
            stuck = ", ".join(np.array(self.names)[self._stuck_on])
            raise ScenarioError(key, f"the others cannot hold against {stuck} stuck on")
        return allocation

    @property
    def constants(self) -> str:
        """What its functions depend on, besides their arguments."""
        return repr((self.settings, self.sample_time))

    @property
    def carries_over(self) -> bool:
        """Whether the commanded impulse that was not fired is requested again; a trigger's filter
        does this by itself.
        """
        return self.settings.modulator != "pwpf"

    def initial_memory(self) -> dict[str, np.ndarray]:
        """Memory between samples, of closed thrusters but for what is stuck on.

        By thruster (n): for how long from now on each is open, s; the share of its force that it
        gives now; forces of the last allocation, N; output of the filter of its Schmitt trigger,
        and whether that is on (1 or 0). The part of the wrench given by the last allocation (1).
        """
        none = np.zeros(len(self.names))
        closed = dict.fromkeys(("open_for", "wanted", "filtered", "is_on"), none)
        return {**closed, "level": self._stuck_on.astype(float), "given": np.ones(1)}

    def most(self, direction: np.ndarray) -> float:
        """The largest multiple of a wrench (6; base's axes, N m and N) that they give."""
        beyond = 10.0 * float(self.force.sum()) / float(np.linalg.norm(direction))
        return beyond * float(self._allocation.solve(beyond * direction, self._leak)[1])

    @property
    def reach(self) -> dict[str, np.ndarray]:
        """Torques (3, n; base's axes, N m) of combinations of thrusters without a force, and forces
        (N) of those without a torque.
        """
        torques, forces = np.split(self.wrenches[:, self._works] * self.force[self._works], 2)
        return {
            kind: own @ np.linalg.svd(other)[2][3:].T
            for kind, own, other in (("torque", torques, forces), ("force", forces, torques))
        }

    def allocate(self, wrench: np.ndarray, memory: Arrays) -> Arrays:
        """The start of a frame: memory with the opening times for a commanded wrench (6; base's
        axes, N m and N).

        A wrench that is not finite gives forces that are not finite: the run has diverged.
        """
        known = np.isfinite(wrench).all(keepdims=True)
        all_known = not may_be(~known)
        solvable = wrench if all_known else np.where(known, wrench, 0.0)
        forces, part = self._allocation.solve(solvable, self._leak)
        given = np.expand_dims(part, -1)
        wanted = np.zeros_like(forces, shape=(len(self.names),))
        wanted[self._works] = forces
        open_for = np.maximum(memory["open_for"], self._opened(wanted))
        found = {"wanted": wanted, "given": given, "open_for": open_for}
        if not all_known:
            found = {name: np.where(known, values, np.nan) for name, values in found.items()}
        return {**memory, **found}

    def _opened(self, wanted: np.ndarray) -> np.ndarray:
        """For how long (n), s, commanded forces (n), N, open at the start of a frame."""
        if not self.carries_over:  # a trigger opens at any sample
            return np.zeros_like(wanted)
        share, settings = wanted / self.force, self.settings
        if settings.modulator == "sigma_delta":
            return whole_frames(share, frame=self.frame, threshold=settings.threshold)
        return pulse_widths(share, frame=self.frame, minimum=settings.minimum_on_time)

    def fire(self, memory: Arrays) -> tuple[Firing, Arrays]:
        """One control sample, from the memory at its start, after any allocation."""
        filtered, is_on, open_for = memory["filtered"], memory["is_on"], memory["open_for"]
        if not self.carries_over:
            filtered, is_on = self._trigger.step(memory["wanted"] / self.force, filtered, is_on)
            # for the rest of a pulse, or a new
            least = np.where(memory["is_on"] > 0.0, self.sample_time, self._shortest)
            open_for = np.maximum(open_for, is_on * least)
        opened = np.minimum(open_for, self.sample_time)
        opened[self._stuck_on] = self.sample_time
        share, level = mean_level(
            memory["level"],
            opened,
            sample_time=self.sample_time,
            rise=self.settings.rise_time,
            fall=self.settings.fall_time,
        )
        force = share * self.force
        # A remainder from rounding would be a pulse of its own.
        left = open_for - opened
        left[left < 1e-9 * self.sample_time] = 0.0
        firing = Firing(
            self.wrenches.dot(force), force, opened / self.sample_time, memory["given"], share
        )
        is_on = (opened > 0.0) * 1.0
        after = {"open_for": left, "level": level, "filtered": filtered, "is_on": is_on}
        return firing, {**memory, **after}

    def failing(self, firing: Firing, gain: np.ndarray, floor: np.ndarray) -> Firing:
        """The output with a factor on each force, and a least share of it (n)."""
        force = np.maximum(gain * firing.level, floor) * self.force
        return firing._replace(force=force, wrench=self.wrenches.dot(force))


@dataclasses.dataclass(frozen=True, kw_only=True)
class FiredThrusters(BaseActuator):
    """Signals and metrics of the thrusters of a scenario's own actuators."""

    title = "Thrusters"
    section = "Actuators"
    about = ""
    fails_as, fault_kinds = "thrusters", THRUSTER_FAULTS
    settings: Thrusters
    units: Mapping[str, Thruster]

    @classmethod
    def of(cls, scenario: Scenario) -> "FiredThrusters | None":
        """The thrusters of a scenario."""
        settings = allocated(scenario).thrusters
        return None if settings is None else cls(settings=settings, units=thrusters_of(settings))

    @classmethod
    def failing_units(cls, scenario: Scenario, coordinates: Coordinates) -> Sequence[str]:
        """Every thruster."""
        part = cls.of(scenario)
        return () if part is None else [*part.units]

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Forces, open valves, and what of the commanded wrench they could give."""
        by_unit = functools.partial(Signal, components=tuple(self.units), dimension="thruster")
        return (
            by_unit(
                name="thruster_force",
                unit="N",
                meaning="mean force of each thruster from this sample to the next",
                heading="",
            ),
            by_unit(
                name="thruster_open",
                unit="1",
                meaning="open share of the sample for each thruster",
                heading="Firings",
                panel="Open valves",
                chart=TIMELINE,
            ),
            Signal(
                name="thruster_given",
                unit="1",
                meaning="share of the commanded wrench that the last allocation to thrusters gives",
                heading="",
            ),
        )

    def constants(self, setup: BlockSetup) -> Sequence[Constant]:
        """Specific impulses of the thrusters."""
        impulses = [unit.specific_impulse for unit in self.units.values()]
        return [
            Constant(
                name="specific_impulse",
                unit="s",
                meaning="specific impulse",
                dimension="thruster",
                values=impulses,
            )
        ]

    def metrics(self) -> Sequence[Metric]:
        """Propellant; impulse, pulses and open time by thruster and in total; share of unmet
        commands.

        ``propellant_of_force`` is a lower bound for any layout: the propellant of ideal thrusters
        along the feasible part of the commanded base force, the integral of its size over the
        largest specific impulse.
        """
        grams = functools.partial(Metric, unit="kg", shown="g", factor=1e3)
        return (
            grams(
                key="thrusters.propellant",
                label="Propellant",
                column="propellant",
                heading="propellant [kg]",
                ranked=True,
                of=lambda run: (self._impulse(run) / self._exhaust).sum(),
            ),
            grams(
                key="thrusters.propellant_of_force",
                label="Lower bound, for the commanded force",
                column="",
                of=self._least_propellant,
            ),
            self._by_unit("impulse", "N s", self._impulse),
            _of_all("impulse", "N s", self._impulse),
            self._by_unit("pulses", "1", _count),
            _of_all("pulses", "1", _count, heading="pulses"),
            self._by_unit("on_time", "s", lambda run: _opened(run).sum(axis=0) * _period(run)),
            Metric(key="thrusters.shortest_pulse", unit="s", column="", of=_shortest),
            Metric(
                key="thrusters.saturated",
                unit="1",
                label="Samples with less than the commanded wrench",
                heading="thrusters saturated [share]",
                shown="%",
                of=lambda run: self.saturated(run)[:-1].mean() if len(run.time) > 1 else 0.0,
            ),
        )

    def _by_unit(self, key: str, unit: str, of: Callable[[View], np.ndarray]) -> Metric:
        return Metric(
            key=f"thrusters.{key}",
            unit=unit,
            column="",
            of=lambda run: dict(zip(self.units, of(run).tolist(), strict=True)),
        )

    def solids(self) -> Iterator[Solid]:
        """Nozzles, of lengths as the cube root of the force, and the plumes at their mouths."""
        strongest = max(unit.force for unit in self.units.values())
        for name, unit in self.units.items():
            nozzle = 0.05 * (unit.force / strongest) ** (1.0 / 3.0)
            cone = functools.partial(
                Solid, name=name, shape="cone", axis=-np.array(unit.direction, dtype=float),
                position=np.array(unit.position, dtype=float),
            )  # fmt: skip
            yield cone(
                group="thrusters",
                length=nozzle,
                radius=0.45 * nozzle,
                color=(0.55, 0.57, 0.62, 1.0),
            )
            yield cone(
                group="plumes", length=0.35, radius=0.063, color=(1.0, 0.93, 0.65, 0.65),
                shown_by="thruster_open", legend="pale cones: open thrusters",
            )  # fmt: skip

    def most(self, scenario: Scenario, directions: np.ndarray) -> Mapping[str, np.ndarray]:
        """Torque and force."""
        return _most_along(self.settings, scenario.sample_time, directions)

    def reach(self, scenario: Scenario) -> Mapping[str, np.ndarray]:
        """Torque without force, and force without torque."""
        return ThrusterSet(self.settings, sample_time=scenario.sample_time).reach

    def saturated(self, signals: Signals) -> np.ndarray:
        """Whether they give less than the commanded wrench."""
        return np.squeeze(signals["thruster_given"]) < _WHOLE

    def advice(self, scenario: Scenario, load: Load) -> Iterator[Advice]:
        """Remedies: the shortest frame, and those for any actuator of their groups."""
        shortest = math.ceil(self.settings.minimum_on_time / scenario.sample_time - 1e-9)
        if self.settings.frame > max(1, shortest):
            yield Advice(
                changes={"actuation.thrusters.frame": max(1, shortest)},
                reason="the shortest that minimum_on_time allows",
            )
        alone = scenario.actuation.wheels is None
        yield from load.advice("base_position", *(("base_rotation",) if alone else ()))

    def sentence(self, figures: Sequence[Figure]) -> str:
        """Propellant, impulse and pulses."""
        found = by_key(figures)
        propellant, least, shortest = (
            1e3 * found[f"thrusters.{name}"]
            for name in ("propellant", "propellant_of_force", "shortest_pulse")
        )
        bound = (
            ""
            if not least <= propellant
            else (f" (the commanded force alone: at least {short(least)} g)")
        )
        return (
            f"thrusters: {short(propellant)} g of propellant{bound}, impulse "
            f"{short(found['thruster_impulse'], 4)} N s in "
            f"{counted(found['thruster_pulses'], 'pulse')}"
            + ("" if math.isnan(shortest) else f", the shortest {shortest:.3g} ms")
            + f"; less than the commanded wrench in {percent(found['thrusters.saturated'])} of the "
            "samples"
        )

    def table(self, figures: Sequence[Figure]) -> Sequence[Sequence[str | float]]:
        """Impulse, pulses and open time of each thruster."""
        found = by_key(figures)
        impulse, pulses, opened = (
            found[f"thrusters.{name}"] for name in ("impulse", "pulses", "on_time")
        )
        return [
            ("thruster", "impulse [N s]", "pulses", "open [s]"),
            *((name, impulse[name], pulses[name], opened[name]) for name in self.units),
        ]

    @property
    def _exhaust(self) -> np.ndarray:
        """Exhaust speed of each thruster, m/s."""
        return STANDARD_GRAVITY * np.array([unit.specific_impulse for unit in self.units.values()])

    def _impulse(self, run: View) -> np.ndarray:
        """Impulse of each thruster, N s."""
        impulse: np.ndarray = run["thruster_force"][:-1].sum(axis=0) * _period(run)
        return impulse

    def _least_propellant(self, run: View) -> float:
        members = [group == "base_position" for group in run.coordinates.group_of]
        force = run["generalized_force"][:-1, members] * run["thruster_given"][:-1].reshape(-1, 1)
        wanted = float(np.linalg.norm(force, axis=1).sum() * _period(run))
        return wanted / float(self._exhaust.max())


@memoized(maxsize=16)
def _most_along(
    settings: Thrusters, sample_time: float, directions: np.ndarray
) -> dict[str, np.ndarray]:
    """The largest torque and force (n) along directions (n, 3; base's axes)."""
    thrusters, none = ThrusterSet(settings, sample_time=sample_time), np.zeros_like(directions)
    return {
        kind: np.array([thrusters.most(each) for each in np.hstack(parts)])
        for kind, parts in (("torque", (directions, none)), ("force", (none, directions)))
    }


def _of_all(name: str, unit: str, of: Callable[[View], np.ndarray], *, heading: str = "") -> Metric:
    return Metric(
        key="",
        unit=unit,
        label=name.capitalize(),
        column=f"thruster_{name}",
        heading=heading,
        of=lambda run: of(run).sum(),
    )


def _period(run: View) -> float:
    return run.scenario.sample_time


def _opened(run: View) -> np.ndarray:
    return run["thruster_open"][:-1]


def _pulses(run: View) -> list[np.ndarray]:
    """Lengths of the pulses of each thruster, s."""
    return [pulses_of(column, _period(run))[1] for column in _opened(run).T]


def _count(run: View) -> np.ndarray:
    """The pulses of each thruster."""
    return np.array([each.size for each in _pulses(run)])


def _shortest(run: View) -> float | None:
    """Shortest of all pulses that end within the run, s; a valve open at the end is cut off
    there.
    """
    ended = [
        each[: each.size - int(column[-1:].sum() == 1.0)]
        for each, column in zip(_pulses(run), _opened(run).T, strict=True)
    ]
    return min((float(each.min()) for each in ended if each.size), default=None)
