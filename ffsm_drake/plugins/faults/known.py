"""What fault detection knows beforehand: units, sensors and models."""

import itertools

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.actuators.base import LOST, STUCK_ON
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.plugins.actuators.row import make_base_actuators
from ffsm_drake.plugins.actuators.thruster_faults import THRUSTER_FAULTS
from ffsm_drake.plugins.actuators.wheel_set import WHEEL_STOPS
from ffsm_drake.plugins.estimators.assumed_noise import assumed_noise
from ffsm_drake.plugins.faults import payload_error
from ffsm_drake.plugins.faults.bounds import Bounds
from ffsm_drake.plugins.faults.features import FIRED
from ffsm_drake.plugins.faults.features import WINDOWS as FORCE_WINDOWS
from ffsm_drake.plugins.faults.jam import JAMMED
from ffsm_drake.plugins.faults.memory import Layout, Memory
from ffsm_drake.plugins.faults.models import Models
from ffsm_drake.plugins.faults.panels import AGO, SIZE, SPANS
from ffsm_drake.plugins.faults.payload_error import NUM_ERRORS, force_by_errors
from ffsm_drake.plugins.faults.sensors import (
    SENSOR_FAULTS,
    entries_in_state,
    reports_losses,
    sensors_of,
)
from ffsm_drake.plugins.faults.windows import BATCH, EVERY
from ffsm_drake.plugins.faults.wrists import Wrists
from ffsm_drake.scenario import Scenario, thrusters_of
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import damping_of
from ffsm_drake.spacecraft.plant import find_frame
from ffsm_drake.systems.sensing.errors import measurement_times
from ffsm_drake.systems.setup import BlockSetup

_FAULTS = (*THRUSTER_FAULTS, WHEEL_STOPS, JAMMED, *SENSOR_FAULTS)
# lost samples at random are reported as silence
SUSPECTED = "suspected"  # one of several units is faulty
KINDS = ("", *(kind.name for kind in _FAULTS if not kind.at_random), SUSPECTED)
CODE = {kind: float(code) for code, kind in enumerate(KINDS)}
# blocks that sensors and wheels compare; looks until a slope is known
KEPT, OLD = 61, 20
WINDOWS = (8, 24, 60)  # blocks of sensors and wheels
SPAN = 65  # blocks that are kept
LEARNT = 50  # samples, or blocks, after which a variance is known
_BANDWIDTH = {"base_rotation": 8.0, "base_position": 2.0, "joints": 10.0}  # rad/s


def units_of(scenario: Scenario, coordinates: Coordinates) -> list[str]:
    """All units that may be reported, with the names in ``faults``."""
    thrusters, wheels = scenario.actuation.thrusters, scenario.wheels
    return [
        *(f"thrusters.{name}" for name in ({} if thrusters is None else thrusters_of(thrusters))),
        *(f"wheels.{name}" for name in ({} if wheels is None else wheels.units)),
        *(f"joints.{name}" for name in coordinates.joints),
        *(f"sensing.{name}" for name in sensors_of(coordinates)),
    ]


class Known:
    """Constants of a scenario, and functions of a state."""

    def __init__(self, setup: BlockSetup) -> None:
        scenario, coordinates = setup.scenario, setup.coordinates
        assert scenario.faults is not None
        assert scenario.faults.detection is not None
        self._settings, self._step = scenario.faults.detection, setup.sample_time
        self._model, self.units = setup.nominal, units_of(scenario, coordinates)
        self._nq, self._nv = len(coordinates.position_names), len(coordinates.names)
        # the nominal payload changes at a grasp
        held = setup.grip.carried(scenario.payload).nominal
        # and a hand that closes later changes the forces
        self._wrists, self._has_wrists = Wrists(setup), len(scenario.contacts) > 1
        self._leg = float(held.mass) + self._wrists.size
        factor = self._settings.payload_factor if setup.grip.holds else 1.0
        self._box = payload_error.intervals(held, factor)
        payload: tuple[Frame, np.ndarray] | None = None
        if held.mass > 0.0:
            frame = find_frame(self._model.plant, scenario.payload.body, key="payload.body")
            payload = frame, np.array(held.center_of_mass, dtype=float)
        self._damping = damping_of(self._model.plant)
        self._is_flexible = bool(scenario.model.flexible)
        actuation = allocated(scenario)
        self._base = None
        if actuation.thrusters is not None or actuation.wheels is not None:
            self._base = make_base_actuators(
                actuation, coordinates, sample_time=self._step, detects=True
            )
        self._read_sensors(scenario, coordinates)
        # of the observer of lost velocities: three equal poles for each coordinate, without
        # steady-state error under a constant unreported force
        w = coordinates.vector(_BANDWIDTH, key="bandwidth", default=0.0)
        self._gains = np.array([3.0 * w, 3.0 * w**2, w**3]) * self._step
        self._lay_out()
        wrenches = np.zeros((6, 0)) if self._thrusters is None else self._thrusters.wrenches
        self._models = Models(self._model, Bounds(setup), wrenches, payload)

    def _read_sensors(self, scenario: Scenario, coordinates: Coordinates) -> None:
        """Read the sensors' properties: update pattern and noise."""
        self._sensors = sensors_of(coordinates)
        self._sensor_names = tuple(self._sensors)
        self._sensor_entries = tuple(self._sensors.values())
        self._of_sensors = np.array([self._unit(name) for name in self._sensors])
        # a sensor's entries, and its columns of the state, follow those of the one before
        self._widths = np.array([len(each) for each in self._sensor_entries])
        self._entries = np.array([each[0] for each in self._sensor_entries])
        self._columns = np.array([entries_in_state(each)[0] for each in self._sensor_entries])
        period, delay = measurement_times(scenario.sensing, coordinates)
        self._is_prompt = (period == 1) & (delay == 0)
        self._patience = 3 * period + delay  # control samples without anything new
        noise = assumed_noise(scenario, coordinates)
        self._position_noise, self._velocity_noise = noise
        quantized = [
            coordinates.vector(of, key="sensing", default=0.0)
            for of in (
                scenario.sensing.position_quantization,
                scenario.sensing.velocity_quantization,
            )
        ]
        self._is_fine = np.concatenate(quantized) == 0.0
        self._position_noise = self._position_noise + quantized[0]
        self._velocity_noise = self._velocity_noise + quantized[1]
        are_exact = self._is_prompt & self._is_fine
        self._is_fine_state = np.concatenate([are_exact[:1], are_exact])
        self._are_prompt = np.logical_and.reduceat(self._is_prompt, self._entries)
        self._is_exact = np.logical_and.reduceat(are_exact, self._entries)
        self._least_patience = self._patience[self._entries]
        self._may_be_old = reports_losses(scenario) or bool((period > 1).any())
        self._sees_forces = bool(self._is_prompt.all())

    def _lay_out(self) -> None:
        nv, base, size = self._nv, self._base, self._nq + self._nv
        self._joints = tuple(self._model.coordinates.joints)
        self._thrusters, self._wheels = (
            (None, None) if base is None else (base.thrusters, base.wheels)
        )
        of_joints = [self.units.index(f"joints.{name}") for name in self._joints]
        self._of_joints = np.array(of_joints, dtype=int)
        self._force = np.zeros(0) if self._thrusters is None else self._thrusters.force
        self._num_units = 0 if base is None else len(base.units)
        self._num_wheels = self._num_units - len(self._force)
        self._none_isolated = np.zeros(self._num_units)
        # columns of a block: unexplained velocities, slips, motions, velocities, those that errors
        # of the payload need, each one, impulses of thrusters, commanded impulses of wheels,
        # momenta that wheels did not take
        count, wheels = len(self._force), self._num_wheels
        widths = {"left": nv, "slip": nv, "moved": nv, "velocity": nv}
        widths |= {"errors": nv * NUM_ERRORS, "impulse": count}
        self._at = _columns(widths | {"told": wheels, "beyond": wheels})
        # columns of a sample: state, commands, momenta and whether measurements are new; force,
        # slip and motion since the sample before
        widths = {"state": size, "told": self._num_units, "momentum": wheels, "force": nv}
        widths |= {"pressed": nv * self._has_wrists}
        widths |= {"new": size * self._may_be_old, "slip": nv, "moved": nv}
        self._in = _columns(widths)
        width, units = self._at["beyond"].stop, len(self._joints) + count
        rows = 2 * len(FORCE_WINDOWS) + 1
        shapes: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("raw", "seen", "stale", "observed"), (size,)),
            **dict.fromkeys(("off", "since"), (2 * nv,)),
            **dict.fromkeys(("jitter", "room", "rough", "slope", "acceleration"), (nv,)),
            "sums": (width,), "repeats": (len(self._sensors),),
            "pulses": (len(FIRED), count, count + nv * (1 + NUM_ERRORS) + 4),
            "kept": (SPAN, width), "states": (SPAN // BATCH + 1, size),
            "against": (rows, units), "voted": (rows,), "agreed": (3,),
            "doubted": (2 + units,),
            "pressed": (nv * self._has_wrists,),
            "grows": (len(SPANS) * self._is_flexible,),
            "grown": ((AGO // BATCH + 1) * self._is_flexible, len(SPANS), SIZE),
        }  # fmt: skip
        self._layout = Layout(shapes, (1 + BATCH * EVERY, self._in["moved"].stop))

    def _unit(self, sensor: str) -> int:
        return self.units.index(f"sensing.{sensor}")

    def _isolated(self, codes: np.ndarray) -> np.ndarray:
        """Codes for the actuators (units)."""
        assert self._base is not None
        if not np.count_nonzero(codes[: self._num_units]):
            return self._none_isolated
        told = (codes[: self._num_units] > 0.0) * LOST
        if not self._settings.isolation_valves:
            told[codes[: told.size] == CODE["stuck_on"]] = STUCK_ON
            told[codes[: told.size] == CODE["leaking"]] = 0.0
        return told

    def _changes(self, rows: np.ndarray, samples: float) -> tuple[np.ndarray, ...]:
        """Momenta that wheels did not take (m, wheels), and changes of velocity: those that the
        reported forces, with measured wheel torques, explain (m, nv), and those that errors of the
        payload of one unit each need (m, nv, 10).

        The model is that at the ends of blocks, with even steps between them. An error of the
        payload acts at all times of a window: the motion in its middle does not tell its mean.

        Args: rows (m + 1) of samples; how many samples of the leg were before.
        """
        states, force = rows[:, self._in["state"]], rows[1:, self._in["force"]]
        before = states[:-1]
        moves = 0.5 * (before + states[1:])[:, self._nq :]
        force = force - self._damping * moves
        beyond = np.zeros((len(before), self._num_wheels))
        if self._wheels is not None:
            told = rows[:-1, self._in["told"]][:, -self._num_wheels :]
            beyond = np.diff(rows[:, self._in["momentum"]], axis=0) - self._step * told
            beyond[: max(2 - int(samples), 0)] = 0.0
            axes = matrix_of(before[:, :4]) @ self._wheels.axes
            force[:, :3] -= (axes @ beyond[..., None])[..., 0] / self._step
        every = min(len(before), EVERY)
        ends = [self._models.dynamics(state) for state in states[::every]]
        _, inverse, bias, jacobian = map(np.array, zip(*ends, strict=True))
        at = _between(jacobian, every)
        turns = np.diff(jacobian, axis=0).repeat(every, axis=0) / every
        twist = at @ moves[..., None]
        change = at @ np.diff(states[:, self._nq :], axis=0)[..., None] + turns @ moves[..., None]
        inverse = self._step * _between(inverse, every)
        needed = force_by_errors(at, twist[..., 0], change[..., 0] / self._step)
        return (
            beyond,
            (inverse @ (force - _between(bias, every))[..., None])[..., 0],
            -inverse @ needed,
        )

    @staticmethod
    def _forget(memory: Memory) -> None:
        """Begin all windows with the next block."""
        memory.blocks = memory.span = -1.0 - memory.done // EVERY


def _between(ends: np.ndarray, count: int) -> np.ndarray:
    """Values in the middle of samples (m, ...), from values at the ends of so many of them."""
    shares = ((np.arange(count) + 0.5) / count).reshape(-1, *[1] * (ends.ndim - 1))
    found: np.ndarray = ends[:-1, None] + shares * np.diff(ends, axis=0)[:, None]
    return found.reshape(-1, *ends.shape[1:])


def _columns(widths: dict[str, int]) -> dict[str, slice]:
    """Slices of parts that follow one another."""
    ends = itertools.pairwise(itertools.accumulate(widths.values(), initial=0))
    return {name: slice(*pair) for name, pair in zip(widths, ends, strict=True)}
