"""Reaction wheels of a scenario: their signals, limits and metrics."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ffsm_drake.common.numbers import percent, short
from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.plugins.actuators.wheel_set import WHEEL_STOPS, WheelSet
from ffsm_drake.scenario import Scenario, Wheels
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import Limit
from ffsm_drake.systems.parts.actuator import BaseActuator
from ffsm_drake.systems.parts.advice import Advice, Load
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.signals import (
    INTERNAL_TORQUE,
    STEPS,
    STORED_MOMENTUM,
    Constant,
    Signal,
    Signals,
    View,
)
from ffsm_drake.systems.parts.solid import Solid
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReactionWheels(BaseActuator):
    """Signals and metrics of the wheels of a scenario's own actuators."""

    title = "Wheels"
    section = "Actuators"
    about = ""
    fails_as, fault_kinds = "wheels", (WHEEL_STOPS,)
    settings: Wheels

    @classmethod
    def of(cls, scenario: Scenario) -> "ReactionWheels | None":
        """The wheels of a scenario."""
        return None if scenario.wheels is None else cls(settings=scenario.wheels)

    @classmethod
    def failing_units(cls, scenario: Scenario, coordinates: Coordinates) -> Sequence[str]:
        """Every wheel."""
        return () if scenario.wheels is None else [*scenario.wheels.units]

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Momentum, torque and speed of the wheels, and their torque on the base."""
        by_unit = functools.partial(
            Signal, components=tuple(self.settings.units), dimension="wheel"
        )
        in_world = functools.partial(
            Signal, components=("x", "y", "z"), dimension="axis", heading=""
        )
        return (
            by_unit(
                name="wheel_momentum",
                unit="N m s",
                meaning="momentum of each wheel about its axis",
                heading="Wheels: momentum",
            ),
            by_unit(
                name="wheel_torque",
                unit="N m",
                meaning="torque of each wheel's motor from this sample to the next",
                heading="Wheels: torque of the motors",
                chart=STEPS,
            ),
            in_world(
                name="wheel_reaction",
                unit="N m",
                meaning="torque of the wheels on the base, constant over a sample; part of "
                "applied_force",
                role=INTERNAL_TORQUE,
            ),
            in_world(
                name="stored_momentum",
                unit="N m s",
                meaning="momentum of the wheels in the world frame, part of angular_momentum",
                held=False,
                role=STORED_MOMENTUM,
            ),
            Signal(
                name="wheel_unloads",
                unit="1",
                meaning="1 while thrusters unload the wheels",
                heading="",
            ),
            by_unit(
                name="wheel_speed",
                unit="rad/s",
                meaning="speed of each wheel in the base",
                heading="",
                of=self._speed,
            ),
        )

    def constants(self, setup: BlockSetup) -> Sequence[Constant]:
        """Limits of the wheels."""
        return [
            Constant(
                name=name,
                unit=unit,
                meaning=meaning,
                dimension="wheel",
                values=self._by_unit(name).tolist(),
            )
            for name, unit, meaning in (
                ("torque_limit", "N m", "largest torque of the motor, in both directions"),
                ("speed_limit", "rad/s", "largest speed in the base, in both directions"),
            )
        ]

    def limits(self, coordinates: Coordinates) -> Sequence[Limit]:
        """Speed of each wheel, torque of its motor."""
        return self._limit("speed", "rad/s"), self._limit("torque", "N m")

    def metrics(self) -> Sequence[Metric]:
        """Peaks by wheel; shares of limits; shares of the samples."""

        def peak(key: str, signal: str, unit: str) -> Metric:
            return Metric(
                key=f"wheels.{key}",
                unit=unit,
                column="",
                of=lambda run: dict(
                    zip(self.settings.units, np.abs(run[signal]).max(axis=0).tolist(), strict=True)
                ),
            )

        share = functools.partial(Metric, unit="1", shown="%")
        return (
            peak("peak_momentum", "wheel_momentum", "N m s"),
            peak("peak_speed", "wheel_speed", "rad/s"),
            peak("peak_torque", "wheel_torque", "N m"),
            share(
                key="wheels.speed_used",
                label="Speed, share of a wheel's limit",
                column="wheel_speed_used",
                heading="wheel speed [share of limit]",
                of=lambda run: self._limit("speed", "rad/s").used(run["wheel_speed"]).max(),
            ),
            share(
                key="wheels.torque_used",
                label="Torque, share of a motor's limit",
                column="wheel_torque_used",
                heading="",
                of=lambda run: self._torque_used(run).max(),
            ),
            share(
                key="wheels.torque_limited",
                label="Samples with a motor at its limit",
                heading="torque at the limit [share]",
                of=lambda run: self.saturated(run).mean(),
            ),
            share(
                key="wheels.unloading",
                label="Samples with unloading",
                heading="unloading [share]",
                of=lambda run: run["wheel_unloads"].mean(),
            ),
        )

    def solids(self) -> Sequence[Solid]:
        """A disc for each wheel on its axis."""
        return [
            Solid(
                group="wheels", name=name, shape="disc", axis=np.array(unit.axis, dtype=float),
                position=np.zeros(3), offset=0.12, length=0.015, radius=0.06, through=True,
                color=(0.55, 0.95, 0.75, 0.55), legend="discs in the base: reaction wheels",
            )
            for name, unit in self.settings.units.items()
        ]  # fmt: skip

    @property
    def is_helped(self) -> bool:
        """Whether thrusters assist the wheels."""
        return self.settings.assist_above is not None

    def most(self, scenario: Scenario, directions: np.ndarray) -> Mapping[str, np.ndarray]:
        """Torque."""
        wheels = self.storage(scenario)
        return {"torque": np.array([wheels.most(each) for each in directions])}

    def reach(self, scenario: Scenario) -> Mapping[str, np.ndarray]:
        """Torque."""
        return {"torque": self.storage(scenario).reach}

    def locked(self, scenario: Scenario) -> Scenario:
        """Without wheels, whose mass is part of the base's."""
        actuation = dataclasses.replace(scenario.actuation, wheels=None)
        return dataclasses.replace(scenario, actuation=actuation)

    def saturated(self, signals: Signals) -> np.ndarray:
        """Whether a motor is at its limit."""
        return np.asarray((self._torque_used(signals) > 1.0 - 1e-9).any(axis=-1))

    def advice(self, scenario: Scenario, load: Load) -> Iterator[Advice]:
        """The thrusters' help, and what helps any actuator of the base's rotation."""
        given = load.groups.get("base_rotation")
        if given is not None and scenario.actuation.thrusters is not None and not self.is_helped:
            yield Advice(
                changes={"actuation.wheels.assist_above": 1.0},
                reason=f"thrusters give the torque beyond the wheels' {short(given.limit)} N m",
            )
        yield from load.advice("base_rotation")

    def storage(self, scenario: Scenario) -> WheelSet:
        """Themselves."""
        alone = scenario.actuation.thrusters is None
        return WheelSet(self.settings, sample_time=scenario.sample_time, alone=alone)

    def sentence(self, figures: Sequence[Figure]) -> str:
        """Peak use of the wheels."""
        found = by_key(figures)
        speed, torque, limited, unloading = (
            percent(found[f"wheels.{name}"])
            for name in ("speed_used", "torque_used", "torque_limited", "unloading")
        )
        return (
            f"wheels: up to {speed} of the speed and {torque} of the torque of a wheel, a motor at "
            f"its limit in {limited} of the samples; unloaded in {unloading}"
        )

    def table(self, figures: Sequence[Figure]) -> Sequence[Sequence[str | float]]:
        """Peak momentum, speed and torque of each wheel, beside its limits."""
        found = by_key(figures)
        momentum, speed, torque = (
            found[f"wheels.peak_{name}"] for name in ("momentum", "speed", "torque")
        )
        headings = (
            "wheel",
            "peak momentum [N m s]",
            "peak speed [rad/s]",
            "limit",
            "peak torque [N m]",
            "limit",
        )
        return [
            headings,
            *(
                (
                    name,
                    momentum[name],
                    speed[name],
                    unit.speed_limit,
                    torque[name],
                    unit.torque_limit,
                )
                for name, unit in self.settings.units.items()
            ),
        ]

    def _by_unit(self, name: str) -> np.ndarray:
        return np.array([getattr(unit, name) for unit in self.settings.units.values()], dtype=float)

    def _limit(self, name: str, unit: str) -> Limit:
        largest, names = self._by_unit(f"{name}_limit"), tuple(self.settings.units)
        return Limit(
            quantity=f"wheel_{name}", source=f"actuation.wheels: {name}_limit", names=names,
            units=(unit,) * len(names), upper=largest, lower=-largest,
        )  # fmt: skip

    def _torque_used(self, signals: Signals) -> np.ndarray:
        return self._limit("torque", "N m").used(signals["wheel_torque"])

    def _speed(self, run: View) -> np.ndarray:
        """Speeds (n, wheels) in the base, rad/s."""
        state, first = run["state"], len(run.coordinates.position_names)
        w_WB = in_body_axes(state[:, :4], state[:, first : first + 3])
        axes = self._by_unit("axis")
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        speed: np.ndarray = run["wheel_momentum"] / self._by_unit("inertia") - w_WB @ axes.T
        return speed
