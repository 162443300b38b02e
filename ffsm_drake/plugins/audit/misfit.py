"""Residual between a path and the integral of its rate, and the mistake that explains it.

The paths are attitudes, positions and joints' angles with their rates, and joints' momenta with
their efforts. A mistake is a column (its effect on the residual) with a size. Least squares find
the size; leaving out parts of the log gives its standard error.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ffsm_drake.plugins.audit.checks import AMBIGUOUS, UNEXPLAINED, Check, fault, undecided
from ffsm_drake.plugins.audit.log import Array, Log, every

NAMED = 0.15  # largest share of the residual that a named mistake may leave
SURE = 0.03  # the same, for residuals within the doubt of sampling, digits or noise
_ALIKE = 4.0  # ratio of the remainders of two mistakes that cannot be told apart
TRIMMED = 0.9  # share of the periods used in a fit; jumps are found separately
STILL = 1e-9  # rad or m
_FOLDS = 8  # parts of a log that are left out in turn, for standard errors
_MOST = 2000  # samples of a fit
DOUBTS = {
    "sampling": "a coarser sampling changes it as much: log more samples, and all known signals",
    "digits": "the last digits of the numbers change it as much: log more digits",
    "noise": "it jumps as much from sample to sample: log true values",
    "integrator": "the drift of an integrator explains as much: log a run with shorter steps",
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Mistake:
    """A mistake that may explain the residual."""

    cause: str
    text: str  # {0} stands for its sizes with their errors, {1} for the first, {2}, ...
    columns: Sequence[Array]  # changes of the residual, each for a size of 1
    changes: Sequence[Array] = ()  # corrections of the logged rate, each for size 1
    unit: str = ""
    factor: float = 1.0  # the number in the text is offset + factor * size
    offset: float = 0.0
    least: float = -math.inf  # limits of the first size
    most: float = math.inf
    floors: (
        Sequence[float] | float
    ) = -math.inf  # smallest physically possible size, or one for each
    more: int = 0  # number of further sizes that are not fitted here
    bent: Array | float = 0.0  # part of the residual that the columns of fitted sizes leave


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Sizes of a mistake, and the residual that remains with it."""

    mistake: Mistake
    sizes: Array
    errors: Array  # standard errors
    left: float  # largest remaining residual
    others: Sequence["Estimate"] = ()  # other mistakes that explain the residual about as well
    is_sure: bool = True  # False: others are about as good, and none is complete

    @property
    def count(self) -> int:
        """Number of sizes."""
        return len(self.sizes) + self.mistake.more

    @property
    def cause(self) -> str:
        """Cause, or the causes that cannot be told apart."""
        causes = [x.mistake.cause.split(" or ") for x in (self, *self.others)]
        joined = " or ".join(dict.fromkeys(itertools.chain.from_iterable(causes)))
        return joined if self.is_sure else AMBIGUOUS

    @property
    def is_possible(self) -> bool:
        """Whether the sizes are beyond their errors and within their limits."""
        mistake, errors = self.mistake, 3.0 * self.errors
        possible = (self.sizes >= np.array(mistake.floors) - errors).all()
        found = possible and (np.abs(self.sizes) > errors).any()
        return bool(found and mistake.least < self.sizes[0] < mistake.most)

    def __str__(self) -> str:
        sizes = np.maximum(self.sizes, self.mistake.floors)
        numbers = self.mistake.offset + self.mistake.factor * sizes
        said = about(numbers, abs(self.mistake.factor) * self.errors, self.mistake.unit)
        words = ", or ".join([self.mistake.text.format(said, *numbers), *map(str, self.others)])
        return words if self.is_sure else f"{words}; none of these explains all of it"


def swing(path: Array) -> float:
    """Largest distance of a path (n, k) from its mean."""
    return float(np.linalg.norm(path - path.mean(axis=0), axis=1).max(initial=0.0))


def since_start(parts: Array) -> Array:
    """Sum since the start (n, k) of contributions of each period (n - 1, k)."""
    return np.concatenate([np.zeros_like(parts[:1]), np.cumsum(parts, axis=0)])


def means(values: Array) -> Array:
    """Means over each period (n - 1, k) by the trapezoidal rule."""
    return 0.5 * (values[1:] + values[:-1])


def slopes(time: Array, rate: Array) -> Array:
    """Correction (n - 1, k) of the trapezoidal rule over each period for a smooth rate (n, k)."""
    slope = np.gradient(rate, time, axis=0, edge_order=2)
    return -(np.diff(time)[:, None] ** 2) / 12.0 * np.diff(slope, axis=0)


def areas(time: Array, rate: Array) -> Array:
    """Integral (n - 1, k) of a smooth rate (n, k) over each period, to the fourth order."""
    return np.diff(time)[:, None] * means(rate) + slopes(time, rate)


def about(values: Array, errors: Array | None, unit: str) -> str:
    """An estimated number or vector, with the largest standard error."""
    numbers = ", ".join(f"{x + 0.0:.4g}" for x in values)
    size = numbers if len(values) == 1 else f"[{numbers}]"
    return f"{size} {unit}" if errors is None else f"{size} ± {errors.max():.1g} {unit}"


def estimate(missed: Array, mistake: Mistake, lag: Array) -> Estimate:
    """Fit the sizes of columns (n, k) by least squares.

    A lag within half a period, as an integrator or a hold causes, is fitted too. The standard
    errors are those of a jackknife, which leaves out parts of the log.
    """
    count = len(mistake.columns)
    table = np.stack([*mistake.columns, lag], axis=2)
    table = table - table.mean(axis=0)
    flat = missed - mistake.bent
    flat = flat - flat.mean(axis=0)
    norms = np.sqrt((table**2).sum(axis=(0, 1)))
    norms = np.where(norms > 0.0, norms, np.inf)
    table = table / norms
    parts = np.array_split(np.arange(len(flat)), _FOLDS)
    squares = np.array([np.einsum("nki,nkj->ij", table[p], table[p]) for p in parts])
    sums = np.array([np.einsum("nki,nk->i", table[p], flat[p]) for p in parts])

    def solve(square: Array, right: Array) -> Array:
        found: Array = np.linalg.pinv(square, rcond=1e-12, hermitian=True) @ right
        if abs(found[count]) > 0.5 * norms[count]:
            found[count] = math.copysign(0.5 * norms[count], found[count])
            inner = np.linalg.pinv(square[:count, :count], rcond=1e-12, hermitian=True)
            found[:count] = inner @ (right[:count] - square[:count, count] * found[count])
        return found

    square, right = squares.sum(axis=0), sums.sum(axis=0)
    sizes = solve(square, right)
    others = np.array([solve(square - a, right - b) for a, b in zip(squares, sums, strict=True)])
    errors = np.sqrt((_FOLDS - 1) * others.var(axis=0))
    return Estimate(
        mistake=mistake,
        sizes=(sizes / norms)[:count],
        errors=(errors / norms)[:count],
        left=swing(flat - table @ sizes),
    )


_NONE = Mistake(cause="", text="", columns=())


def named(
    missed: Array,
    lag: Array,
    mistakes: Iterable[Mistake],
    doubt: float,
    *,
    share: float = NAMED,
    sure: float = SURE,
) -> Estimate | None:
    """Choose the mistake that explains the residual.

    It has the fewest sizes among those about as good as the best. If others with no more sizes are
    about as good, it is sure only if it leaves little of a residual beyond the doubt, within the
    doubt.

    Args:
      share: largest share of a residual beyond the doubt that the mistake may leave.
      sure: largest share of a residual within the doubt that the mistake may leave.

    Returns:
      The mistake; its sizes have at least the relative error that it leaves. None if none explains
      the residual.
    """
    before = estimate(missed, _NONE, lag).left
    is_beyond = before > doubt
    most = max(share * before, doubt) if is_beyond else min(share, sure) * before
    tried = [
        dataclasses.replace(
            each, errors=np.maximum(each.errors, np.abs(each.sizes) * each.left / before)
        )
        for mistake in mistakes
        if (each := estimate(missed, mistake, lag)).is_possible
    ]
    tried.sort(key=lambda each: each.left)
    if not tried or tried[0].left > most:
        return None
    enough = min(max(_ALIKE * tried[0].left, 0.5 * doubt if is_beyond else 0.0), most)
    found = min((each for each in tried if each.left <= enough), key=lambda each: each.count)
    both = dataclasses.replace(
        found,
        others=[
            each for each in tried
            if each is not found and each.count <= found.count and each.left < _ALIKE * found.left
        ],
    )  # fmt: skip
    whole = is_beyond and found.left <= min(doubt, sure * before)
    alike = all(x.cause in found.cause or found.cause in x.cause for x in both.others)
    return dataclasses.replace(both, is_sure=whole or alike)


def noise(values: Array, parts: Array | None = None) -> float:
    """Bound of the noise from sample to sample in values (n, k). If the values are sums of
    ``parts`` (n - 1, k), it includes the random walk of the noise in the parts.
    """
    found = 4.0 * _white(values)
    return found if parts is None else found + 3.0 * math.sqrt(len(parts)) * _white(parts)


def _white(values: Array) -> float:
    """Standard deviation of white noise on smooth values (n, k); the norm over the columns."""
    third = np.diff(values, n=3, axis=0)
    return float(np.linalg.norm(np.sqrt((third**2).mean(axis=0) / 20.0)))


def open_by_steps(paths: Sequence[Array]) -> float:
    """Bound of the quadrature error of a path.

    It is a Richardson extrapolation of the paths with every, every second and every fourth
    sample, with the observed gain of the steps.
    """
    first, second = (
        swing(coarse - fine[::2][: len(coarse)]) for fine, coarse in itertools.pairwise(paths)
    )
    gain = min(first / second, 0.9) if second > 0.0 else 0.0
    return first * max(1.0, 2.0 * gain / (1.0 - gain))


def greatest(doubts: dict[str, float]) -> tuple[float, str]:
    """The largest of some doubts, and its reason."""
    why = max(doubts, key=lambda each: doubts[each])
    return doubts[why], why


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Displacements of a path in each period, and its rate."""

    time: Array  # (n), s
    rate: Array  # (n, k)
    moved: Array  # (n - 1, k)
    beside: float | Array = 0.0  # expected displacement in addition to the rate's integral

    @property
    def slope(self) -> Array:
        """Correction of the trapezoidal rule for a smooth rate (n - 1, k)."""
        return slopes(self.time, self.rate)

    @property
    def expected(self) -> Array:
        """The integral of a smooth rate, to the fourth order."""
        return areas(self.time, self.rate) + self.beside

    @property
    def lag(self) -> Array:
        """Residual (n - 1, k) if the rates are those of one period later."""
        return np.diff(self.time)[:, None] * np.diff(self.rate, axis=0)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Followed:
    """Comparison of a path with its rate, without jumps."""

    log: Log
    motion: Callable[[Log, int], Motion]  # at every so many samples of a log
    size: float = 0.0  # residuals are shares of this size; 0: the motion's own
    drifts: Callable[[], bool] = lambda: False  # True: integrator drift may explain it
    sure: float = SURE  # 0: the doubt may look like a mistake

    @functools.cached_property
    def parts(self) -> Motion:
        return self.motion(self.log, 1)

    @functools.cached_property
    def expected(self) -> Array:
        return self.parts.expected

    @functools.cached_property
    def beyond(self) -> Array:
        """Residual in each period (n - 1, k)."""
        return self.parts.moved - self.expected

    @functools.cached_property
    def jumps(self) -> Array:
        """Periods (n - 1) whose residual is far larger than in the others."""
        parts, missed = self.parts, np.linalg.norm(self.beyond, axis=1)
        most = np.maximum(*(np.linalg.norm(x, axis=1) for x in (parts.moved, self.expected)))
        usual = np.linalg.norm(np.abs(parts.lag) + 3.0 * np.abs(parts.slope), axis=1)
        return missed > np.maximum(
            10.0 * np.quantile(missed, TRIMMED), np.maximum(0.3 * most, usual)
        )

    @property
    def jumped(self) -> float:
        """Size of the jumps."""
        return swing(since_start(self.beyond * self.jumps[:, None]))

    def path(self, parts: Array) -> Array:
        """Sum since the start of contributions (n - 1, k) without jumps, at some samples (m, k)."""
        rows = every(len(parts) + 1, most=_MOST)
        return since_start(parts * ~self.jumps[:, None])[rows]

    @functools.cached_property
    def lag(self) -> Array:
        return self.path(self.parts.lag)

    @functools.cached_property
    def missed(self) -> Array:
        """The smaller of two residuals (m, k): of a smooth rate, and of a piecewise linear rate, as
        held efforts have.
        """
        both = (self.beyond, self.beyond + self.parts.slope)
        return min((self.path(x) for x in both), key=lambda x: estimate(x, _NONE, self.lag).left)

    @functools.cached_property
    def scale(self) -> float:
        return self.size or max(swing(self.path(x)) for x in (self.parts.moved, self.expected))

    @functools.cached_property
    def left(self) -> float:
        """Largest residual after a fitted lag within half a period."""
        return estimate(self.missed, _NONE, self.lag).left

    @property
    def share(self) -> float:
        return self.left / self.scale if self.scale else 0.0

    @functools.cached_property
    def doubt(self) -> tuple[float, str]:
        """Bound of the path's error, and its reason: sampling, digits, noise or an integrator."""

        def path(log: Log, step: int = 1) -> Array:
            parts = self.motion(log, step)
            jumps = self.jumps[: step * len(parts.moved)].reshape(-1, step)
            kept = np.all(~jumps, axis=1, keepdims=True)
            return since_start((parts.moved - parts.expected) * kept)

        paths = [path(self.log, step) for step in (1, 2, 4)]
        slope = 0.5 * swing(since_start(self.parts.slope * ~self.jumps[:, None]))
        digits, resampled = (
            2.0 * swing(path(log) - paths[0]) for log in (self.log.shaken, self.log.resampled)
        )
        doubts = {
            "sampling": max(open_by_steps(paths), slope, resampled),
            "noise": noise(paths[0], self.parts.expected),
            "digits": digits,
        }
        drifts = max(doubts.values()) < self.left and self.drifts()
        return (math.inf, "integrator") if drifts else greatest(doubts)

    def named(self, mistakes: Iterable[Mistake]) -> Estimate | None:
        """The mistake that explains the residual; the columns are per period (n - 1, k)."""
        return named(
            self.missed, self.lag, map(self._along, mistakes), self.doubt[0], sure=self.sure
        )

    def _along(self, mistake: Mistake) -> Mistake:
        return dataclasses.replace(mistake, columns=[self.path(x) for x in mistake.columns])

    def factor(self) -> Estimate:
        """Fit of the factor between motion and expected motion. Size 0 means that they agree."""
        scale = Mistake(cause="scale", text="", columns=[self.expected])
        return estimate(self.missed, self._along(scale), self.lag)

    def judged(
        self, name: str, said: str, mistakes: Iterable[Mistake], tolerance: float
    ) -> tuple[Check, Estimate | None]:
        """Check of a residual beyond the tolerance, and the mistake that explains it, if any."""
        found = self.named(mistakes)
        if found and (found.is_sure or self.left > self.doubt[0]):
            return fault(name, found.cause, f"{said} {found}"), found
        (doubt, why), missed = self.doubt, f"{said} misses {100.0 * self.share:.2g} %"
        if self.left > max(tolerance * self.scale, doubt):
            return fault(name, UNEXPLAINED, f"{missed}, which no one mistake explains"), None
        return undecided(name, why, f"{missed}, but {DOUBTS[why]}"), None


def common_factor(factors: Sequence[float], errors: Sequence[float] | float) -> float | None:
    """Median factor; None if one differs by more than 5 % of the median's distance from 1 plus
    three standard errors.
    """
    values = np.array(factors)
    found = float(np.median(values)) if len(values) > 1 else 1.0
    unlike = np.abs(values - found) > 0.05 * abs(found - 1.0) + 3.0 * np.array(errors)
    return None if found == 1.0 or unlike.any() else found
