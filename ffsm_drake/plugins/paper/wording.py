# ruff: noqa: RUF001, RUF002 (the texts use mathematical signs)
"""Numbers as text."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

from ffsm_drake.common import numbers
from ffsm_drake.plugins.paper.runs import Run

T = TypeVar("T")
NAMES = {"tde_aismc": "proposed", "aismc": "AISMC", "asmc": "ASMC", "tdc": "TDC"}
DISTURBANCE_NAMES = {
    "tau_d1": "τ_d1",
    "tau_d2": "τ_d2 (3 × frequency)",
    "tau_d3": "τ_d3 (3 × amplitude)",
}


def scientific(value: float, digits: int = 3) -> str:
    """A number such as 1.70×10⁻⁴; infinity, for a diverged run, becomes words."""
    return numbers.scientific(value, digits) if math.isfinite(value) else "diverged"


def fixed(value: float, digits: int = 3) -> str:
    """A number such as 12.3; infinity as in ``scientific``."""
    return numbers.number(value, digits) if math.isfinite(value) else "diverged"


def percent(share: float) -> str:
    """A percentage such as 25 % or 0.3 %."""
    return f"{fixed(100.0 * share, 2)} %" if math.isfinite(share) else "diverged"


def times(value: float) -> str:
    """A ratio such as 0.984 or 1.016; three digits if it is far from one."""
    return f"{value:.3f}" if 0.1 <= value < 10.0 else fixed(value)


def span(values: Iterable[float], digits: int = 3) -> str:
    """'smallest to largest', or a single value if they round to the same text."""
    return between(values, lambda value: fixed(value, digits))


def times_span(values: Iterable[float]) -> str:
    """As ``span``, for ratios."""
    return between(values, times)


def between(values: Iterable[float], write: Callable[[float], str]) -> str:
    """'smallest to largest', formatted by ``write``."""
    everything = list(values)
    finite = sorted(value for value in everything if math.isfinite(value))
    if not finite:
        return "diverged"
    low, high = write(finite[0]), write(finite[-1])
    text = low if low == high else f"{low} to {high}"
    return text if len(finite) == len(everything) else f"{text} (others diverged)"


def itae_of(run: Run) -> str:
    """The run's ITAE, or its time of divergence."""
    return scientific(run.itae) if run.outcome.completed else ending(run)


def ending(run: Run) -> str:
    """An ending such as 'diverged at 5.3 s'."""
    return f"{run.outcome.status} at {run.outcome.time:.1f} s"


def named(values: Mapping[str, T], write: Callable[[T], str], separator: str = ", ") -> str:
    """Values by controller or group, such as 'proposed 0.16, AISMC 0.10'."""
    return separator.join(
        f"{NAMES.get(name, name.replace('_', ' '))} {write(value)}"
        for name, value in values.items()
    )


def listed(items: Iterable[str]) -> str:
    """'a, b and c'."""
    *first, last = list(items) or [""]
    return f"{', '.join(first)} and {last}" if first else last


def fate(run: Run) -> str:
    """'completes', or how it ended."""
    return "completes" if run.outcome.completed else ending(run)


def signed(share: float) -> str:
    """A signed percentage such as +1.2 %."""
    if not math.isfinite(share):
        return "divergence"
    return f"{100.0 * share:+.1f} %" if abs(share) >= 5e-4 else "less than 0.1 %"
