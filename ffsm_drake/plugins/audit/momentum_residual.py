"""Total momentum of a log minus the impulse of its forces."""

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

from ffsm_drake.plugins.audit.dynamics import Bodies, Dynamics
from ffsm_drake.plugins.audit.log import Array, Log, only
from ffsm_drake.plugins.audit.misfit import (
    SURE,
    Estimate,
    Mistake,
    areas,
    greatest,
    means,
    named,
    noise,
    since_start,
    swing,
)


def _impulses(log: Log) -> list[Array]:
    """Impulse (n, 6) of the forces on the base since the start, as momenta.

    There are three conventions: a force is sampled, held after each sample, or held before it. A
    disturbance is smooth in all of them.
    """
    place, period = log.position - log.position[0], np.diff(log.time)[:, None]
    moment, push = log.disturbance[:, :3], log.disturbance[:, 3:6]
    smooth = areas(log.time, np.hstack([moment + np.cross(place, push), push]))
    arm = means(place)
    return [
        since_start(np.hstack([torque + np.cross(arm, force), force]) * period + smooth)
        for torque, force in (
            (means(log.torque), means(log.force)),
            (log.torque[:-1], log.force[:-1]),
            (log.torque[1:], log.force[1:]),
        )
    ]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Residual:
    """Momenta at some samples of a log, and the relative change of their total."""

    log: Log  # mended: rates in world axes
    dynamics: Dynamics
    kept: Array  # indices of the samples

    @functools.cached_property
    def some(self) -> Log:
        """The samples, with positions from the first."""
        some = only(self.log, self.kept)
        return some.replace(position=some.position - self.log.position[0])

    @functools.cached_property
    def bodies(self) -> Bodies:
        return self.dynamics.bodies_of(self.some)

    @functools.cached_property
    def momenta(self) -> tuple[Array, Array]:
        return self.bodies.momenta(self.some)

    @functools.cached_property
    def scale(self) -> Array:
        """Momentum exchanged by the bodies (6), N m s and N s. For one body: its own momentum."""
        whole = np.sum(self.momenta, axis=0)
        shares = (self.dynamics.masses / self.dynamics.mass)[:, None]
        drift = whole[..., 3:].sum(axis=1, keepdims=True) * shares
        angular, linear, beside = (
            np.abs(x).sum(axis=1).max()
            for x in (whole[..., :3], whole[..., 3:], whole[..., 3:] - drift)
        )
        scale = np.repeat([angular, max(beside, 1e-3 * linear)], 3)
        return np.where(scale > 1e-12, scale, 1.0)

    @functools.cached_property
    def impulse(self) -> Array:
        """Impulse of the logged forces (n, 6), in the convention that conserves momentum best,
        divided by ``scale``.
        """
        total = self.total(self.some, bodies=self.bodies)
        each = [impulse[self.kept] / self.scale for impulse in _impulses(self.log)]
        return min(each, key=lambda impulse: swing(total - impulse))

    @functools.cached_property
    def missed(self) -> Array:
        """The residual (n, 6) of the log."""
        return self.residual(self.some, bodies=self.bodies)

    def residual(self, log: Log, *, bodies: Bodies | None = None) -> Array:
        """Total momentum (n, 6) of samples minus the impulse of the logged forces, divided by
        ``scale``.
        """
        return self.total(log, bodies=bodies) - self.impulse

    def total(self, log: Log, *, bodies: Bodies | None = None) -> Array:
        """Total momentum (n, 6) of samples, divided by ``scale``."""
        momenta = (bodies or self.dynamics.bodies_of(log)).momenta(log)
        return np.sum(momenta, axis=(0, 2)) / self.scale

    @functools.cached_property
    def share(self) -> float:
        """Largest deviation of a component of ``missed`` from its mean."""
        return float(np.abs(self.missed - self.missed.mean(axis=0)).max())

    @functools.cached_property
    def doubt(self) -> tuple[float, str]:
        """Bound of the error of the momentum, and its reason."""
        groups = np.split(self.missed, np.flatnonzero(np.diff(self.kept) > 1) + 1)
        total = self.total(self.some, bodies=self.bodies)
        fine, coarse = (_impulses(only(self.log, slice(None, None, k)))[0] for k in (1, 2))
        doubts = {
            "noise": 2.0 * max(noise(group) for group in groups if len(group) > 3),
            "sampling": 0.7 * swing((coarse - fine[::2]) / self.scale),
        }
        if self.log.unsure:
            change = 2.0 * swing(self.total(self.some.resampled) - total)
            doubts["sampling"] = max(doubts["sampling"], change, doubts.pop("noise"))
        if any(self.log.digits.values()):
            doubts["digits"] = 3.0 * swing(self.total(self.some.shaken) - total)
        return greatest(doubts)

    def named(self, mistakes: Iterator[Mistake], *, share: float = SURE) -> Estimate | None:
        """The mistake that explains the residual; None if none does."""
        no_lag = np.zeros_like(self.missed)
        return named(self.missed, no_lag, mistakes, self.doubt[0], share=share)
