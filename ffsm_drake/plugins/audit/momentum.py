"""Check that only the logged forces change the momentum, and the mistake that explains the rest."""

import dataclasses
import functools

import numpy as np

from ffsm_drake.plugins.audit.checks import UNEXPLAINED, Check, fault, undecided
from ffsm_drake.plugins.audit.dynamics import Dynamics
from ffsm_drake.plugins.audit.log import Log
from ffsm_drake.plugins.audit.misfit import DOUBTS, Estimate
from ffsm_drake.plugins.audit.momentum_mistakes import mistakes_of, of_integrator
from ffsm_drake.plugins.audit.momentum_residual import Residual

_GROUPS = 60  # places of the log at which momentum is compared, of four samples each
_DRIFTED = 0.2  # largest share of the residual that an integrator's drift may leave


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Momentum(Residual):
    """Momenta at some samples of a log, and what explains that their total changes."""

    @functools.cached_property
    def mistake(self) -> Estimate | None:
        """The mistake that explains the residual; None if none does."""
        return self.named(mistakes_of(self))

    @functools.cached_property
    def drift(self) -> Estimate | None:
        """The drift of a first-order integrator that explains the residual; its size is the step,
        s. None if no step explains it.
        """
        return self.named(of_integrator(self), share=_DRIFTED)

    @property
    def excuses_efforts(self) -> bool:
        """Whether the doubt or the drift of an integrator explains the residual."""
        return self.share <= self.doubt[0] or self.drift is not None


def check_momentum(log: Log, dynamics: Dynamics, tolerance: float) -> tuple[Check, Momentum]:
    """Check of momentum, in shares of the momentum exchanged by the bodies."""
    size, name = len(log.time), "momentum"
    starts = np.linspace(0, size - 4, min(_GROUPS, size // 4)).astype(int)
    kept = np.unique(starts[:, None] + np.arange(4))
    found = Momentum(log=log, dynamics=dynamics, kept=kept)
    if not np.isfinite(found.missed).all():
        raise ValueError("momentum is not finite")
    if found.share <= tolerance:
        said = f"conserved within {found.share:.2g} of what the bodies exchange"
        if log.unsure:
            said += f" (rates of every second sample change it by {found.doubt[0]:.1g})"
        return Check(name=name, statement=said), found
    said = f"changes by {found.share:.2g} of what the bodies exchange"
    if explained := found.mistake:
        words = f"{said}, by {explained.left:.2g} if {explained}"
        return fault(name, explained.cause, words), found
    doubt, why = found.doubt
    if found.share <= doubt:
        return undecided(name, why, f"{said}, but {DOUBTS[why]}"), found
    if found.drift:
        words = (
            f"{said}, of which {found.drift.left:.2g} is not drift of an integrator with steps of "
            f"{found.drift.sizes[0]:.2g} s; log a run with shorter steps"
        )
        return undecided(name, "integrator", words), found
    words = "no single mistake explains it; there are several, or a varying force is not logged"
    return fault(name, UNEXPLAINED, f"{said}; {words}"), found
