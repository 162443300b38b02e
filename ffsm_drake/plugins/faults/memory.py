"""What fault detection remembers from sample to sample."""

import itertools
import math
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np

from ffsm_drake.systems.sampled import Arrays

_NUMBERS = ("samples", "blocks", "looks", "span", "clock", "tries", "was_off", "jumped")
_REPLACED = ("kept", "states")  # when samples are collected; never changed in place
HEAD = ("leg", "count", "limit", "done")  # before the rows of samples
_NONE = np.zeros(0)


class Layout:
    """Places of what is remembered: small arrays are parts of one vector, after the numbers."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], rows: tuple[int, int]) -> None:
        """Args: shapes of all arrays of ``Memory``, except ``codes``, and of ``rows``."""
        self.rows = rows
        # vectors stay as they are
        self.shapes = {
            name: shape for name, shape in shapes.items() if name in _REPLACED or len(shape) > 1
        }
        sizes = {n: math.prod(shape) for n, shape in shapes.items() if n not in _REPLACED}
        ends = itertools.pairwise(itertools.accumulate(sizes.values(), initial=len(_NUMBERS)))
        self.places = {name: slice(*pair) for name, pair in zip(sizes, ends, strict=True)}

    def start(self, units: int) -> "Memory":
        """Zeros, with so many units."""
        last = max(place.stop for place in self.places.values())
        rows = np.zeros(len(HEAD) + math.prod(self.rows))
        arrays = {"codes": np.zeros(units), "abort_request": np.zeros(1), "rows": rows}
        arrays["own"] = np.zeros(last)
        large = {name: np.zeros(math.prod(self.shapes[name])) for name in _REPLACED}
        return Memory(self, arrays | large)


class Memory(SimpleNamespace):
    """What the detector remembers from sample to sample; methods change it in place.

    Of each thruster, wheel, joint and sensor: the ``codes`` found. Of sensors: ``raw`` and ``seen``
    state, before and after corrections; biases ``off``, base's axes; for how many samples each is
    ``stale``, and how often it ``repeats`` its bits; slips ``since`` then, and their mean square
    ``jitter``; ``observed`` state and ``acceleration`` in place of lost velocities; the usual
    ``slope`` of slips, after so many ``looks``; whether a velocity ``was_off``. ``kept`` blocks of
    ``sums``, and how many ``blocks`` form a window of sensors, or a ``span`` of forces, in blocks
    of the ``clock``; ``states`` at ends of batches; ``grown`` forces of flexible parts, for
    ``grows`` blocks; ``pulses`` of thrusters. Of decisions: squares ``against`` each unit, when
    windows ``voted`` last, the unit that ``agreed``, units that are ``doubted``, and for how many
    looks there were ``tries``. Samples of this ``leg``, which the payload's mass tells. ``rows``:
    the last sample before a batch, then a ``count`` of its samples, of which some are ``done``.
    Those before the ``limit`` may wait, if their slips are below ``room``. ``rough``: mean square
    of unexplained changes; whether the last sample ``jumped``. ``pressed``: force of wrists.

    A small array is a view of ``own``, a vector: it is written into, never replaced.
    """

    def __init__(self, layout: Layout, arrays: Arrays) -> None:
        """Args: layout; what ``arrays`` returned, which is not changed."""
        own, known = np.array(arrays["own"]), vars(self)
        known.update(zip(_NUMBERS, own[: len(_NUMBERS)].tolist(), strict=True))
        known.update({name: own[place] for name, place in layout.places.items()})
        for name, shape in layout.shapes.items():
            values = arrays.get(name, _NONE) if name in _REPLACED else known[name]
            known[name] = values.reshape(shape)
        self.own, self.codes, self.all_rows = own, np.array(arrays["codes"]), arrays["rows"].copy()
        known.update(zip(HEAD, self.all_rows[: len(HEAD)].tolist(), strict=True))
        self.rows = self.all_rows[len(HEAD) :].reshape(layout.rows)
        self.abort_request = float(arrays["abort_request"][0])

    def arrays(self) -> Arrays:
        """Vectors, without empty ones."""
        known = vars(self)
        self.own[: len(_NUMBERS)] = [known[name] for name in _NUMBERS]
        self.all_rows[: len(HEAD)] = [known[name] for name in HEAD]
        found = {name: known[name].reshape(-1) for name in ("codes", "own", *_REPLACED)}
        found["rows"] = self.all_rows
        found["abort_request"] = np.array([self.abort_request])
        return {name: values for name, values in found.items() if values.size}
