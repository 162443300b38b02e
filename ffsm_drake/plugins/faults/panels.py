"""The largest force of flexible parts on the base, from what was unexplained before."""

import numpy as np

from ffsm_drake.plugins.faults.windows import BATCH, times_of

SPANS = (20, 32, 64)  # blocks of the slopes that are compared
AGO = 40  # blocks: a fault of the last 2 s does not widen its own bound
SIZE = 6  # forces on the base
_TIMES, _LONG, _EARLY, _LEAST = 3.0, 2.0, 5.0, 20.0  # factors; N m or N before anything is known
_NOISES = 2.0


class PanelBound:
    """A multiple of the largest unexplained force of a window until 2 s ago."""

    def __init__(self, grown: np.ndarray, known: np.ndarray) -> None:
        """Args: largest forces up to each of the last batches (m, spans, 6), updated; for how
        many blocks each span is known (spans), updated.
        """
        self._grown, self._known = grown, known

    def update(self, left: np.ndarray, mass: np.ndarray, noise: np.ndarray, step: float) -> None:
        """Take the slopes at the end of a batch into account.

        Args: summed unexplained changes (m, nv) of blocks that are ``step`` s apart; mass matrices
        (spans, nv, nv) in the middle of each of the ``SPANS``; the noise (nv) of a block's
        velocities.
        """
        now = self._grown[-1].copy()
        for row, count in enumerate(SPANS):
            if count > len(left):
                continue
            time = times_of(count, step)
            of = mass[row]
            force = of @ (time @ left[-count:]) / (time @ time)
            rough = np.sqrt(of**2 @ noise**2 / (time @ time))
            beyond = np.maximum(np.abs(force) - _NOISES * rough, 0.0)
            now[row] = np.maximum(now[row], beyond[:SIZE])
            self._known[row] += BATCH
        self._grown[:-1] = self._grown[1:]
        self._grown[-1] = now

    def of(self, window: int, *, is_slope: bool) -> np.ndarray:
        """The largest force (6) in a window of so many blocks."""
        row = next(at for at, count in enumerate(SPANS) if count >= window) if is_slope else 0
        if self._known[row] > AGO:
            least: np.ndarray = (_LONG if row else _TIMES) * self._grown[0, row]
            return least
        early: np.ndarray = _EARLY * self._grown[-1, row] + _LEAST
        return early
