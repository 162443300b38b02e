"""Whether a time-delay law consists of axes: found by trial, so that no law has to declare it."""

from typing import Any

import numpy as np

from ffsm_drake.systems.controllers.time_delay import InjectedDynamics, TimeDelayControl

_SMALL = 1e-6  # times the random inputs: a law with a boundary layer is not linear in both


def law_of_axes(law: Any) -> TimeDelayControl | None:
    """The law for ``one_axis``, its ``by_axis``; None for a law that offers none, or whose dynamics
    do not treat each coordinate separately and linearly while the states of ``held`` are constant.
    """
    own = getattr(law, "by_axis", None)
    return own if own is not None and consists_of_axes(own.dynamics) else None


def consists_of_axes(dynamics: InjectedDynamics) -> bool:
    """Whether the steps of many inputs at once are those of each, linear, and apart by coordinate.

    False for dynamics whose gains are no vectors, or whose step fails.
    """
    try:
        with np.errstate(all="ignore"):
            return _consists_of_axes(dynamics)
    except Exception:  # a user-supplied step, given an input of another shape than in a run
        return False


def _consists_of_axes(dynamics: InjectedDynamics) -> bool:
    held, memory = dynamics.held(), dynamics.initial_state()
    free = [name for name in memory if name not in held]
    (size,) = np.broadcast_shapes(*map(np.shape, vars(dynamics).values()))
    constant = {
        name: memory[name] if value is None else np.full(size, value)
        for name, value in held.items()
    }

    def after(x: np.ndarray) -> np.ndarray:
        """The acceleration and the free memory (n - 1, ..., nv) after x (n, ..., nv)."""
        e, e_dot, *rest = x
        state = {**constant, **dict(zip(free, rest, strict=True))}
        u, found = dynamics.step(e, e_dot, np.zeros_like(e), state)
        outputs = (u, *(found[name] for name in free))
        return np.stack([np.broadcast_to(each, e.shape) for each in outputs])

    inputs = np.random.default_rng(0).standard_normal((2 + len(free), size))
    of_axes = inputs[:, None] * np.eye(size)
    of_inputs = inputs[:, None] * np.eye(len(inputs))[..., None]
    found = after(inputs)
    tried = np.concatenate([_SMALL * inputs[:, None], of_axes, of_inputs], axis=1)
    small, by_axis, by_input = np.split(after(tried), [1, 1 + size], axis=1)
    pairs = (
        (small[:, 0] / _SMALL, found),
        (by_axis, found[:, None] * np.eye(size)),
        (by_input.sum(axis=1), found),
    )
    return all(np.allclose(one, other, rtol=1e-8, atol=1e-8) for one, other in pairs)
