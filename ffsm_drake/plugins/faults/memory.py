"""What fault detection remembers from sample to sample."""

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.systems.sampled import Arrays

_NUMBERS = (
    "leg", "samples", "blocks", "looks", "jumped", "span", "clock", "tries", "was_off",
)  # fmt: skip
_REPLACED = ("kept", "states", "fired")  # at the end of a block; never changed in place
_NONE = np.zeros(0)


class Layout:
    """Places of what is remembered: small arrays are parts of one vector, after the numbers."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Args: shapes of all arrays of ``Memory``, except ``codes``."""
        self.replaced = {name: shapes[name] for name in _REPLACED}
        self._own = {name: shape for name, shape in shapes.items() if name not in _REPLACED}
        sizes = map(math.prod, self._own.values())
        ends = itertools.pairwise(itertools.accumulate(sizes, initial=len(_NUMBERS)))
        self.places = {
            name: (slice(*pair), shape)
            for (name, shape), pair in zip(self._own.items(), ends, strict=True)
        }

    def start(self, units: int) -> "Memory":
        """Zeros, with so many units."""
        last = max(place.stop for place, _ in self.places.values())
        arrays = {"codes": np.zeros(units), "abort_request": np.zeros(1), "own": np.zeros(last)}
        large = {name: np.zeros(math.prod(shape)) for name, shape in self.replaced.items()}
        return Memory(self, arrays | large)


class Memory:
    """What the detector remembers from sample to sample; methods change it in place.

    Of each thruster, wheel, joint and sensor: the ``codes`` found. Of sensors: ``raw`` and ``seen``
    state, before and after corrections; biases ``off``, base's axes; for how many samples each is
    ``stale``, and how often it ``repeats`` its bits; slips ``since`` then, and their mean square
    ``jitter``; ``observed`` state and ``acceleration`` in place of lost velocities; the usual
    ``slope`` of slips, after so many ``looks``; whether the last sample ``jumped``, and whether a
    velocity ``was_off``. Of forces, ``rows`` of the samples of a block, ``kept`` blocks of
    ``sums``, and how many ``blocks`` form a window of sensors, or a ``span`` of forces, in blocks
    of the ``clock``; of the samples of blocks, ``fired`` forces and accelerations; ``states`` at
    ends of blocks; ``rough``: mean square of unexplained changes; ``reach``: largest changes by
    thrusters; ``grown`` forces of flexible parts, for ``grows`` blocks. Of decisions: squares
    ``against`` each unit, when windows ``voted`` last, the unit that ``agreed``, units that are
    ``doubted``, and for how many blocks there were ``tries``. ``told`` force of units and
    ``momentum`` of wheels. Samples of this ``leg``, which the payload's mass tells.

    A small array is a view of a copy of the vector ``own``, made as it is read first. Setting it
    writes into the view.
    """

    def __init__(self, layout: Layout, arrays: Arrays) -> None:
        """Args: layout; what ``arrays`` returned, which is not changed."""
        own = np.array(arrays["own"])
        large = {name: arrays.get(name, _NONE) for name in _REPLACED}
        vars(self).update(zip(_NUMBERS, own[: len(_NUMBERS)].tolist(), strict=True))
        vars(self).update(
            layout=layout,
            own=own,
            codes=np.array(arrays["codes"]),
            abort_request=float(arrays["abort_request"][0]),
            **{name: large[name].reshape(shape) for name, shape in layout.replaced.items()},
        )

    def __getattr__(self, name: str) -> Any:
        """A view of a small array."""
        known = vars(self)
        if name not in known["layout"].places:
            raise AttributeError(name)
        place, shape = known["layout"].places[name]
        known[name] = view = known["own"][place].reshape(shape)
        return view

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in vars(self)["layout"].places:
            vars(self)[name] = value
        elif value is not getattr(self, name):
            getattr(self, name)[...] = value

    def arrays(self) -> Arrays:
        """Vectors, without empty ones."""
        known = vars(self)
        known["own"][: len(_NUMBERS)] = [known[name] for name in _NUMBERS]
        found = {name: known[name].reshape(-1) for name in ("codes", "own", *_REPLACED)}
        found["abort_request"] = np.array([known["abort_request"]])
        return {name: values for name, values in found.items() if values.size}
