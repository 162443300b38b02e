"""Modulators: from commanded forces to opening times of valves, and the resulting force.

A modulator decides at control samples for how long each valve stays open from then on; a valve may
open for part of a sample.
"""

import dataclasses
import math

import numpy as np

_EVEN = 1e-9  # relative tolerance of forces: equal shares open together despite rounding


def whole_frames(share: np.ndarray, *, frame: float, threshold: float) -> np.ndarray:
    """Open times (n, s) of sigma-delta modulation: a whole frame from a threshold on, else
    none.

    What is missed is carried into the next frame's share by the caller: the error's integral stays
    bounded.

    Args: commanded share of each thruster's force (n); length of a frame, s; threshold of the
      share.
    """
    return np.where(share >= threshold - _EVEN, frame, 0.0)


def pulse_widths(share: np.ndarray, *, frame: float, minimum: float) -> np.ndarray:
    """Open times (n, s) of pulse-width modulation: the share of the frame, or the least time,
    or none.

    Args: commanded share of each thruster's force (n); length of a frame and least open time,
    s.
    """
    wanted = np.minimum(share, 1.0) * frame
    return np.where(
        wanted >= minimum, wanted, np.where(wanted >= 0.5 * minimum - _EVEN, minimum, 0.0)
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SchmittTrigger:
    """Pulse-width pulse-frequency modulation (PWPF): a first-order filter k_m / (T s + 1) before a
    Schmitt trigger.

    The filter's input is the commanded share r of the thruster's force less 1 while the trigger is
    on.
    """

    gain: float  # k_m
    time_constant: float  # T, s
    on: float  # U_on
    off: float  # U_off
    sample_time: float  # s

    def step(
        self, share: np.ndarray, filtered: np.ndarray, is_on: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """One control sample: the filter's output, exact for a held input, and the state of the
        triggers.

        Args:
          share: r (n).
          filtered: (n), the filter's output at the last sample.
          is_on: (n), triggers that were on at the last sample; 1 or 0.
        """
        kept = math.exp(-self.sample_time / self.time_constant)
        filtered = kept * filtered + (1.0 - kept) * self.gain * (share - is_on)
        return filtered, np.where(
            filtered >= self.on, 1.0, np.where(filtered <= self.off, 0.0, is_on)
        )


def mean_level(
    level: np.ndarray, opened: np.ndarray, *, sample_time: float, rise: float, fall: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean share of the force over a sample, and the share at its end, (n) each; first order,
    exact.

    Args:
      level: share at the sample's start (n).
      opened: for how long from then on the valve is open (n), s; closed for the rest.
      sample_time: s.
      rise, fall: time constants, s; 0: at once.
    """
    rise, fall = max(rise, 1e-12), max(fall, 1e-12)
    closed = sample_time - opened
    risen = 1.0 - (1.0 - level) * np.exp(-opened / rise)
    left = np.exp(-closed / fall)
    # The integral of a first-order response is what it would hold, less the time constant times its
    # change.
    total = opened - rise * (risen - level) + fall * risen * (1.0 - left)
    return total / sample_time, risen * left
