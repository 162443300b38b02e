"""A controller of one's own: what it is built from, and a base class that leaves only the control law to write."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ffsm_drake.common.errors import ControllerError, ScenarioError, did_you_mean, one_line
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.scenario import PerCoordinate
from ffsm_drake.spacecraft.coordinates import Coordinates, position_error
from ffsm_drake.spacecraft.nominal import PlantModel

# Outputs that a controller may have besides generalized_force; they are recorded when present, (nv) each.
OPTIONAL_OUTPUTS = ("sliding_variable", "reaching_gain", "switching_gain")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ControllerSetup:
    """What a controller is built from: ``factory(setup)`` returns a LeafSystem with the ports of SampledController."""

    name: str  # the system's name, and the key of its gains in ``controllers.own``
    nominal: PlantModel  # the plant as the controller believes it
    sample_time: float  # L, s
    gains: Mapping[str, PerCoordinate] = dataclasses.field(default_factory=dict)  # as the scenario gives them

    @property
    def coordinates(self) -> Coordinates:
        return self.nominal.coordinates

    def gain_vectors(self, defaults: Mapping[str, float | PerCoordinate]) -> dict[str, np.ndarray]:
        """Every gain as a vector (nv): the scenario's value where it gives one, else the default.

        Raises ScenarioError for a gain that has no default here, or an unknown coordinate.
        """
        place = f"controllers.own.{self.name}"
        for name in self.gains:
            if name not in defaults:
                raise ScenarioError(
                    f"{place}.{name}",
                    f"unknown gain; {self.name} has {', '.join(defaults) or 'no gains'}{did_you_mean(name, defaults)}",
                )
        vectors = {}
        for name, default in defaults.items():
            by_default = dict(default) if isinstance(default, Mapping) else {"all": float(default)}
            values = {**by_default, **self.gains.get(name, {})}
            if "all" in self.gains.get(name, {}):  # the scenario's ``all`` outdoes a default for a group
                values = dict(self.gains[name])
            vectors[name] = self.coordinates.vector(values, key=f"{place}.{name}")
        return vectors


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sample:
    """What a control law sees at t_k. Frames and units: [w_WB, v_WB, joint rates] in the world frame, rad, m, s."""

    q: np.ndarray  # (nq) measured configuration
    v: np.ndarray  # (nv) measured velocity
    q_d: np.ndarray  # (nq) reference
    v_d: np.ndarray  # (nv)
    a_d: np.ndarray  # (nv)
    e: np.ndarray  # (nv) q_d - q, the base's attitude as a rotation vector
    e_dot: np.ndarray  # (nv) v_d - v


class SampledController(LeafSystem):
    """A sampled controller around a control law; a subclass writes ``law``, and ``GAINS`` and ``initial_state`` if any.

    Inputs: estimated_state [q; v] (nq + nv), desired_state [q_d; v_d] (nq + nv), desired_acceleration (nv).
    Outputs, read from the state and held over the period: generalized_force tau (nv), and those of OPTIONAL_OUTPUTS
    that ``initial_state`` names.
    All memory is discrete state, updated every ``sample_time``: nothing may be kept on ``self`` between samples, or a
    reset would not reset it.
    """

    GAINS: ClassVar[Mapping[str, float | PerCoordinate]] = {}  # name -> default, a number or by coordinate or group

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__()
        self.set_name(setup.name)
        self.nominal = setup.nominal
        self.sample_time = setup.sample_time
        self.gains = setup.gain_vectors(self.GAINS)
        self._num_velocities = len(setup.coordinates.names)
        num_states = 2 * self._num_velocities + 1
        self._estimated_state = self.DeclareVectorInputPort("estimated_state", num_states)
        self._desired_state = self.DeclareVectorInputPort("desired_state", num_states)
        self._desired_acceleration = self.DeclareVectorInputPort("desired_acceleration", self._num_velocities)
        memory = self.initial_state()
        if not isinstance(memory, Mapping) or "generalized_force" in memory:
            raise ControllerError(
                f"{setup.name}: initial_state must return a mapping of names to arrays, without 'generalized_force'"
            )
        groups = {"generalized_force": np.zeros(self._num_velocities), **memory}
        self._shapes = {name: np.shape(value) for name, value in groups.items()}
        index = {name: self.DeclareDiscreteState(np.asarray(value, dtype=float)) for name, value in groups.items()}
        for name in ("generalized_force", *OPTIONAL_OUTPUTS):
            if name in index:
                self.DeclareStateOutputPort(name, index[name])
        self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def initial_state(self) -> Mapping[str, np.ndarray]:
        """Name -> initial value (n,) of each piece of the law's memory."""
        return {}

    def law(self, sample: Sample, state: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        """The generalized force tau (nv; N m and N) for a sample, and the memory's next value by name."""
        raise ControllerError(f"{type(self).__name__} must define law(sample, state)")

    def _update(self, context: Context, discrete_values: DiscreteValues) -> None:
        estimated, desired = self._estimated_state.Eval(context), self._desired_state.Eval(context)
        split = self._num_velocities + 1
        q, v, q_d, v_d = estimated[:split], estimated[split:], desired[:split], desired[split:]
        sample = Sample(
            q=q,
            v=v,
            q_d=q_d,
            v_d=v_d,
            a_d=self._desired_acceleration.Eval(context),
            e=position_error(q_d, q),
            e_dot=v_d - v,
        )
        old = context.get_discrete_state()
        names = list(self._shapes)[1:]
        state = {name: np.array(old.value(index)) for index, name in enumerate(names, start=1)}
        returned = self._call_law(sample, state, context.get_time())
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Mapping)):
            raise ControllerError(
                f"{self.get_name()}: law must return (generalized_force, memory), an array and a mapping, "
                f"not {_described(returned)}"
            )
        force, memory = returned
        unknown = [str(name) for name in memory if name not in names]
        if unknown:
            raise ControllerError(
                f"{self.get_name()}: law returned '{unknown[0]}', which initial_state does not name; "
                f"its memory is {', '.join(names) or 'empty'}"
            )
        for index, (name, shape) in enumerate(self._shapes.items()):
            if index and name not in memory:
                raise ControllerError(f"{self.get_name()}: law returned no '{name}'; it must return all its memory")
            try:
                value = np.asarray(memory[name] if index else force, dtype=float)
            except (TypeError, ValueError) as error:
                raise ControllerError(
                    f"{self.get_name()}: law returned '{name}' that is not an array of numbers: {one_line(error)}"
                ) from error
            if value.shape != shape:
                raise ControllerError(
                    f"{self.get_name()}: law returned '{name}' of shape {value.shape}; it must be {shape}"
                )
            discrete_values.set_value(index, value)

    def _call_law(self, sample: Sample, state: Mapping[str, np.ndarray], time: float) -> object:
        try:
            return self.law(sample, state)
        except SystemExit as error:  # would end the process as if all were well
            raise ControllerError(
                f"{self.get_name()}: law called sys.exit at t = {time:.2f} s; raise an exception"
            ) from error


def _described(returned: object) -> str:
    if isinstance(returned, tuple):
        return f"a tuple of {', '.join(type(part).__name__ for part in returned) or 'nothing'}"
    return type(returned).__name__
