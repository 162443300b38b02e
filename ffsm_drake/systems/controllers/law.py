"""The contract of a control law: a frozen object whose ``step`` is a pure function of arrays.

A law declares its gains as fields of a frozen dataclass, each with default, unit and meaning. A
scenario sets them under ``controllers.<name>``, by coordinate, by group or for all coordinates. The
law receives them as vectors (nv).

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class ComputedTorque(ControlLaw):
        model: PlantModel
        k_p: np.ndarray = gain(25.0, "1/s^2", "gain on the error")
        k_d: np.ndarray = gain(10.0, "1/s", "gain on the rate of the error")

        def step(self, sample, state):
            u = sample.a_d + self.k_d * sample.e_dot + self.k_p * sample.e
            return self.model.calc_mass_matrix(sample.q) @ u + self.model.calc_bias(sample.q,
            sample.v), state
"""

import abc
import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ffsm_drake.common.errors import BlockError, ScenarioError, did_you_mean
from ffsm_drake.common.settings import Setting, settings_of
from ffsm_drake.scenario import PerCoordinate
from ffsm_drake.spacecraft.coordinates import GROUPS, Coordinates
from ffsm_drake.systems.parts.signals import UNIT
from ffsm_drake.systems.setup import BlockSetup

State = Mapping[str, np.ndarray]


# a NamedTuple, since it is built in every control update: a frozen dataclass takes five times as
# long
class Sample(NamedTuple):
    """Inputs of a control law at one control sample t_k.

    Vectors are in world axes, with v = [w_WB, v_WB, joint rates]. Units are rad, m, s, N m and N.
    Arrays have the shape (size,).

    Example:
      >>> from ffsm_drake import ControlLaw, load_scenario, simulate
      >>> class Watcher(ControlLaw):
      ...     def step(self, sample, state):
      ...         print(sample.is_first, sample.e.shape)
      ...         return 0.0 * sample.e, state
      >>> scenario = load_scenario("postcapture", ["duration=0.01"])
      >>> _ = simulate(scenario, blocks={"controller": Watcher}, check_stability=False)
      True (11,)
      False (11,)
    """

    q: np.ndarray  # (nq) measured configuration
    v: np.ndarray  # (nv) measured velocity
    q_d: np.ndarray  # (nq) reference
    v_d: np.ndarray  # (nv)
    a_d: np.ndarray  # (nv)
    e: np.ndarray  # (nv) q_d - q, the base's attitude as a rotation vector
    # (nv) rate of e: v_d - v except for the attitude, see coordinates.error_rate
    e_dot: np.ndarray
    applied_force: np.ndarray  # (nv) force over the last period; zero at the first sample
    is_first: bool  # no sample before, or a grasp since
    # (2 nv) mask of new measurements: of each position, then of each velocity; None: all new
    is_new: np.ndarray | None = None
    # (19) desired [quaternion (w, x, y, z) of R_WF; p_WF; w_WF; v_WF; alpha_WF; a_WF] of the
    # frame F of ``reference.frame``; None: there is none, or the law tracks no frame
    desired_frame: np.ndarray | None = None
    # (6 contacts) measured wrenches on the target, for a law with ``contacts_read``
    contact_wrench: np.ndarray | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gain(Setting):
    """The declaration of one gain: a setting of a law."""

    # by coordinate or group, or one number for all; None: no bound
    default: float | PerCoordinate | None
    scalar: bool  # one number for all coordinates
    bound: bool  # an upper bound; null means unbounded
    feedback: bool  # acts on the error; otherwise on the adaptation


def gain(
    default: float | PerCoordinate | None,
    unit: str = "",
    meaning: str = "",
    *,
    scalar: bool = False,
    positive: bool = False,
    bound: bool = False,
    feedback: bool = True,
) -> Any:
    """Declare a gain that a scenario can set, as a field of a control law.

    Args:
      default: one number for all coordinates, or numbers by coordinate or group; None: no bound.
      unit: unit, such as "1/s".
      meaning: one phrase for the documentation, which begins with the quantity.
      scalar: True for a gain that is one number for all coordinates.
      positive: True if the gain must be > 0; otherwise it must be >= 0.
      bound: True for an upper bound, which a scenario can remove with null.
      feedback: True if the gain acts on the error, False if it acts on the adaptation.

    Returns: the field. In a law it is a vector (nv), or a number if ``scalar``.

    Example:
      >>> from dataclasses import dataclass, fields
      >>> from ffsm_drake import ControlLaw, gain
      >>> @dataclass(frozen=True, kw_only=True)
      ... class Spring(ControlLaw):
      ...     k: float = gain(3.0, "N m/rad", "stiffness")
      ...     def step(self, sample, state):
      ...         return self.k * sample.e, state
      >>> [field.name for field in fields(Spring)]
      ['k']
    """
    declared = Gain(
        default=default,
        unit=unit,
        meaning=meaning,
        above=0.0 if positive else -math.inf,
        least=0.0,
        scalar=scalar,
        bound=bound,
        feedback=feedback,
    )
    return dataclasses.field(metadata={"setting": declared})


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReachingGain:
    """The gain K_s on a law's sliding variable s; dK_s/dt = rate |s| sgn(|s| - rest(K_s))."""

    start: np.ndarray  # (nv) 1/s
    # (nv) 1/s, where adaptation is stopped: the start where nothing adapts, infinite where nothing
    # stops it
    largest: np.ndarray
    rate: np.ndarray | None = None  # (nv) alpha; None: K_s is constant
    # K_s (..., nv) -> the |s| at which K_s rests
    rest: Callable[[np.ndarray], np.ndarray] = np.zeros_like

    @property
    def changes(self) -> bool:
        """True if adaptation can change K_s."""
        return self.rate is not None and not np.array_equal(self.largest, self.start)


class ControlLaw(abc.ABC):
    """Base class of control laws. A law is a frozen dataclass with a method ``step``.

    Arrays have the shape (nv,). The other methods are optional. Override them for a law that adapts
    gains, has a sign term, or is to be designed.

    Example:
      >>> from dataclasses import dataclass
      >>> from ffsm_drake import ControlLaw, gain, load_scenario, simulate
      >>> @dataclass(frozen=True, kw_only=True)
      ... class Damper(ControlLaw):
      ...     damping: float = gain(20.0, "N m s/rad", "gain on the error's rate")
      ...     def initial_state(self):
      ...         return {}
      ...     def step(self, sample, state):
      ...         return self.damping * sample.e_dot, state
      >>> scenario = load_scenario("postcapture", ["duration=0.1"])
      >>> record = simulate(scenario, blocks={"controller": Damper}, check_stability=False)
      >>> record.outcome.status
      'completed'
    """

    # True if it tracks a frame: it receives ``desired_frame``, and metrics use the pose of the
    # frame.
    tracks_frame: ClassVar[bool] = False
    # Number of contacts (``contacts``) whose measured wrench it receives.
    contacts_read: ClassVar[int] = 0
    # Smallest change of its inputs (rad, m, per s) in a linearisation. For a law in single
    # precision, a smaller change would be rounding.
    least_change: ClassVar[float] = 0.0
    # Unit of its state ``sliding_variable``.
    sliding_unit: ClassVar[str] = f"{UNIT} per s"

    def initial_state(self) -> State:
        """Return the initial states of the law: name -> array. By default there are none."""
        return {}

    def held(self) -> Mapping[str, float | None]:
        """Return the states that stability analyses hold constant.

        Override this method in a law that adapts a gain slowly, or that has a sign term. Without
        it, the linear verdict on such a law can be "cannot say".

        Returns: name of a state -> the value at which it is held. None: its present value. Use 0
        for the gain of a sign term, which has no derivative.
        """
        return {}

    @property
    def by_axis(self) -> "ControlLaw | None":
        """This law as a time-delay law with decoupled coordinates; None: it is not one.

        Override this property in a law that acts on each coordinate separately and is linear while
        the states of ``held`` are constant. ``ffsm stability`` then prints limits by coordinate.
        """
        return None

    @property
    def reaching_gain(self) -> ReachingGain | None:
        """The reaching gain K_s and its adaptation; None: the law has none.

        Override this property in a law with K_s. Without it, stability analyses do not check the
        values that adaptation can reach.
        """
        return None

    @property
    def random_walks(self) -> tuple[str, ...]:
        """Keys of ``estimator`` that ``ffsm design`` chooses together with the gains, such as
        "walk".

        Override this property in a law with an estimator. By default there are none.
        """
        return ()

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        """Return gains for a new spacecraft, with which ``ffsm new`` starts.

        Override this method if good gains depend on the spacecraft. By default the declared
        defaults are used.

        Args:
          omega: natural frequencies (nv), rad/s.
          mass_matrices: mass matrices of the true spacecraft along its motion (m, nv, nv).

        Returns: name of a gain -> value (nv), or one number.
        """
        return {}

    @abc.abstractmethod
    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """Compute the force and the next state at one control sample.

        Args:
          sample: measurement and reference.
          state: the state at this sample, by name. Do not change its arrays in place.

        Returns: the generalized force tau (..., nv; N m and N), held until the next sample, and the
        state at the next sample.
        """

    def resume(self, state: State, before: "ControlLaw", reference: np.ndarray) -> State:
        """Return the state with which this law continues after the grasp of a target.

        Before the grasp, a copy of the law runs with a model without the target. Override this
        method to convert the state of the copy; by default it is unchanged. Velocities and
        reference jump at the grasp, so the next sample has ``is_first`` set.

        Args:
          state: state of the law before the grasp, by name.
          before: the law before the grasp. It has the same gains.
          reference: [q_d; v_d] (nq + nv) just after the grasp; rad, m, per s.

        Returns: the state at the first sample after the grasp, by name.
        """
        return state

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> "ControlLaw":
        """Return the law for a scenario, with gains, ``model`` and ``sample_time`` as its fields.

        Raises:
          ScenarioError: a gain of unknown or missing coordinates, or out of its range.
          BlockError: another field without a default, or no ``step``.
        """
        return cls(**field_values(cls, setup))


@dataclasses.dataclass(frozen=True, kw_only=True)
class WrappedLaw(ControlLaw):
    """A law around another; all attributes of ControlLaw that it does not override are those of the
    other, except that it is not ``by_axis``.
    """

    law: ControlLaw
    tracks_frame = property(attrgetter("law.tracks_frame"))
    contacts_read = property(attrgetter("law.contacts_read"))
    least_change = property(attrgetter("law.least_change"))
    sliding_unit = property(attrgetter("law.sliding_unit"))
    reaching_gain = property(attrgetter("law.reaching_gain"))
    random_walks = property(attrgetter("law.random_walks"))
    held = property(attrgetter("law.held"))


def gains_of(kind: Any) -> dict[str, Gain]:
    """Return the declared gains of a law by name."""
    return {name: item for name, item in settings_of(kind).items() if isinstance(item, Gain)}


def field_values(kind: type, setup: BlockSetup, **given: Any) -> dict[str, Any]:
    """Return the values of all fields of a law for a setup, including ``given`` ones.

    Raises: the errors of ``ControlLaw.from_setup``.
    """
    for name in getattr(kind, "__abstractmethods__", ()):
        _, *arguments = inspect.signature(getattr(kind, name)).parameters
        raise BlockError(f"{kind.__name__} must define {name}({', '.join(arguments)})")
    gains = gain_values(kind, setup.settings, setup.coordinates, name=setup.name)
    known = {**gains, "model": setup.nominal, "sample_time": setup.sample_time}
    values = given
    for field in dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ():
        if field.name in known:
            values[field.name] = known[field.name]
        elif (
            field.name not in given
            and field.default is dataclasses.MISSING
            and field.default_factory is dataclasses.MISSING
        ):
            raise BlockError(
                f"controller '{setup.name}': field '{field.name}' must be a gain(...), model, "
                "sample_time or have a "
                "default"
            )
    return values


def gain_values(
    kind: Any, given: Mapping[str, Any], coordinates: Coordinates, *, name: str
) -> dict[str, np.ndarray | float]:
    """Return every declared gain of a law: the value of the scenario, or the default.

    Args:
      kind: class of the law.
      given: gains of a scenario: name -> values by coordinate, or null.
      coordinates: coordinates of the spacecraft.
      name: name of the controller, for errors.

    Returns: name -> vector (nv), or a number for a scalar gain. Infinity: no bound.

    Raises:
      ScenarioError: an unknown gain, unknown or missing coordinates, a value out of its range.
    """
    declared, place = gains_of(kind), f"controllers.{name}"
    for gain_name in given:
        if gain_name not in declared:
            raise ScenarioError(
                f"{place}.{gain_name}",
                f"unknown gain; {name} has "
                f"{', '.join(declared) or 'no gains'}{did_you_mean(gain_name, declared)}",
            )
    return {
        gain_name: _value(
            item, given.get(gain_name, _DEFAULT), coordinates, key=f"{place}.{gain_name}"
        )
        for gain_name, item in declared.items()
    }


_DEFAULT: Any = object()


def _value(declared: Gain, given: Any, coordinates: Coordinates, *, key: str) -> np.ndarray | float:
    if given is None and not declared.bound:
        name = key.rpartition(".")[2]
        kind = "a number" if declared.scalar else "a number, or numbers by coordinate"
        raise ScenarioError(
            key, f"must be {kind}, not null: null removes an upper bound, and {name} is not one"
        )
    values = complete_gain(declared, given)
    if values is None:
        return np.full(len(coordinates.names), np.inf)
    if declared.scalar and set(values) != {"all"}:
        raise ScenarioError(key, f"must be one number for all coordinates, not {', '.join(values)}")
    for place, problem in declared.problems(values["all"] if declared.scalar else values, key):
        raise ScenarioError(place, problem)
    if declared.scalar:
        return values["all"]
    return coordinates.vector(values, key=key, default=np.inf if declared.bound else None)


def complete_gain(declared: Gain, given: Any = _DEFAULT) -> PerCoordinate | None:
    """Return a gain by coordinate or group, completed with defaults; None: no bound."""
    value = declared.default if given is _DEFAULT else given
    if value is None:
        return None
    values = _by_name(value)
    # A value for ``all`` overrides the defaults of groups; a given bound replaces all defaults.
    if "all" in values or set(GROUPS) <= set(values) or declared.default is None or declared.bound:
        return values
    return {**_by_name(declared.default), **values}


def _by_name(value: float | Mapping[str, float]) -> PerCoordinate:
    return dict(value) if isinstance(value, Mapping) else {"all": float(value)}


def is_shipped(system: object) -> bool:
    """Whether the class of a system or a law, and of the steps that a law consists of, is Drake's
    or this package's.
    """
    parts = vars(system).values() if dataclasses.is_dataclass(system) else ()
    return type(system).__module__.split(".")[0] in ("pydrake", "ffsm_drake") and all(
        is_shipped(part) for part in parts if hasattr(part, "step")
    )
