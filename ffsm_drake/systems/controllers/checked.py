"""Checks of a user-supplied law's attributes and results against the contract of ControlLaw.

Shipped laws are not checked in a run; the tests hold them to the contract.
"""

import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.guard import calling, failure, is_user_supplied, passes
from ffsm_drake.common.returned import arrays, described, mapping, numbers
from ffsm_drake.systems.controllers.law import ControlLaw, ReachingGain, Sample, State

OWN_STATE = ("generalized_force", "has_previous")  # names that a law's memory cannot have
_REAL = np.dtype(float)
Step = Callable[[Sample, State, float], tuple[np.ndarray, State]]  # with the time, s, for errors


def has_user_code(law: Any) -> bool:
    """True if a law, or the law or dynamics within it, is user-supplied."""
    within = getattr(law, "__dict__", {})
    inner = [within[name] for name in ("law", "dynamics") if name in within]
    return is_user_supplied(type(law)) or any(map(has_user_code, inner))


def memory_of(law: ControlLaw, place: str) -> dict[str, np.ndarray]:
    """Return the initial state of a law, checked. Raises BlockError."""
    at = f"{place}: initial_state"
    memory = arrays(calling(place, lambda: law.initial_state()), at)
    if shared := sorted({*OWN_STATE} & {*memory}):
        raise BlockError(f"{at} names '{shared[0]}', which is the controller's; rename it")
    return memory


def attribute_of(law: ControlLaw, name: str, default: Any) -> Any:
    """Return a law's attribute; the default only where it has none, not where a property fails."""
    missing = inspect.getattr_static(law, name, None) is None
    return getattr(law, name, default) if missing else getattr(law, name)


def reaching_gain_of(law: ControlLaw | None) -> ReachingGain | None:
    """Reaching gain K_s of a law, read from it at each call.

    Raises BlockError: a user-supplied law gives something else.
    """
    gain = None if law is None else attribute_of(law, "reaching_gain", None)
    if gain is not None and not _is_reaching(gain, np.size(getattr(gain, "start", ()))):
        wanted = _ATTRIBUTES["reaching_gain"][2]
        name = type(law).__name__
        raise BlockError(f"controller '{name}': reaching_gain must be {wanted}, not {gain!r:.80}")
    return gain


def check_law(law: ControlLaw, place: str, memory: Mapping[str, np.ndarray], size: int) -> None:
    """Check a user-supplied law's attributes, its memory, and its number nv of velocities.

    Raises BlockError: an attribute raises, or violates the contract of ControlLaw.
    """
    if not has_user_code(law):
        return
    for name, (default, is_right, wanted) in _ATTRIBUTES.items():
        value = calling(f"{place}: {name}", attribute_of, law, name, default)
        if not is_right(value, size):
            raise BlockError(f"{place}: {name} must be {wanted}, not {described(value)}")
    held = calling(place, lambda: getattr(law, "held", dict)())
    _check_held(mapping(held, f"{place}: held"), memory, f"{place}: held")


def _is_flag(value: Any, size: int) -> bool:
    return isinstance(value, bool)


def _is_count(value: Any, size: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_names(value: Any, size: int) -> bool:
    return isinstance(value, tuple) and all(isinstance(each, str) for each in value)


def _is_law(value: Any, size: int) -> bool:
    return value is None or (hasattr(value, "step") and hasattr(value, "dynamics"))


def _is_reaching(value: Any, size: int) -> bool:
    if value is None:
        return True
    if not isinstance(value, ReachingGain) or not callable(value.rest):
        return False
    arrays = [value.start, value.largest, *(() if value.rate is None else (value.rate,))]
    return all(
        isinstance(each, np.ndarray) and each.shape == (size,) and each.dtype.kind in "fiu"
        for each in arrays
    )


# Attribute -> default, check of a value, and description of a valid one.
_ATTRIBUTES: dict[str, tuple[Any, Callable[[Any, int], bool], str]] = {
    "tracks_frame": (False, _is_flag, "True or False"),
    "contacts_read": (0, _is_count, "a number of contacts"),
    "random_walks": ((), _is_names, "a tuple of names"),
    "by_axis": (None, _is_law, "a time-delay law or None"),
    "reaching_gain": (None, _is_reaching, "a ReachingGain of vectors (nv), or None"),
}


def _check_held(held: Mapping[str, Any], memory: Mapping[str, Any], what: str) -> None:
    for name, value in held.items():
        if name not in memory:
            raise BlockError(
                f"{what} names '{name}', which initial_state does not; its memory is "
                f"{', '.join(memory) or 'empty'}"
            )
        real = isinstance(value, (int, float, np.integer, np.floating))
        if value is not None and not (real and math.isfinite(value)):
            raise BlockError(
                f"{what}: '{name}' must be held at a finite number or None, not {value!r:.80}"
            )


def checked_step(law: ControlLaw, place: str) -> Step:
    """Return the ``step`` of a law, with its time (s) for errors.

    Every result of a user-supplied law is checked, in about half a microsecond if it is valid.
    At its first sample, and the first after a grasp, its inputs are read-only. A shipped law's step
    is called directly.
    """
    if not has_user_code(law):
        own = law.step
        return lambda sample, state, time: own(sample, state)
    untried = True

    def step(sample: Sample, state: State, time: float) -> tuple[np.ndarray, State]:
        nonlocal untried
        if untried or sample.is_first:
            untried = False
            for value in (sample.applied_force, *state.values()):
                value.setflags(write=False)
        try:
            returned = law.step(sample, state)
            if _is_right(returned, sample, state):
                return returned
            return _converted(returned, sample.v.shape, state, f"{place}: step")
        except BlockError as error:
            raise BlockError(f"{error}; at t = {time:.2f} s") from error.__cause__ or error
        except BaseException as error:
            if passes(error):
                raise
            raise failure(error, place, time) from error

    return step


def _is_right(returned: Any, sample: Sample, state: State) -> bool:
    """True for arrays of floats in the shapes that they must have; in a hurry."""
    try:
        force, memory = returned
        if force.dtype is not _REAL or force.shape != sample.v.shape:
            return False
        if memory is state:
            return True
        for name, old in state.items():
            value = memory[name]
            if value.dtype is not _REAL or value.shape != old.shape:
                return False
        return len(memory) == len(state)
    except Exception:
        return False


def _converted(
    returned: Any, shape: tuple[int, ...], state: State, what: str
) -> tuple[np.ndarray, State]:
    """Return the results of ``step`` as arrays of floats. Raises BlockError for other results."""
    if not (
        isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Mapping)
    ):
        raise BlockError(
            f"{what} must return (generalized_force, state), an array and a mapping, not "
            f"{described(returned)}"
        )
    force = numbers(returned[0], shape, f"{what} returned 'generalized_force'")
    shapes = {name: np.shape(value) for name, value in state.items()}
    return force, arrays(returned[1], what, shapes=shapes)
