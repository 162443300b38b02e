"""Laws that are called at each control sample, between two functions of a compiled run.

A user-supplied law must return the same for the same sample and memory, in any order of calls.
"""

import ctypes
import functools
import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.plugins.compiled.blocks import Blocks
from ffsm_drake.systems.controllers import SampledController
from ffsm_drake.systems.sampled import Arrays, Now, Sampled

_TRIED = 20  # calls of each law
KIND = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)


class Laws:
    """The laws of the first lanes of a register."""

    def __init__(
        self,
        blocks: Blocks,
        controllers: Sequence[SampledController],
        detectors: Sequence[tuple[Sampled, Arrays]] = (),
    ) -> None:
        """Args: the loop; of each lane its controller, and a detector with its memory."""
        self.stopped: BaseException | None = None  # what ended the runs
        self._blocks, self._controllers = blocks, controllers
        inputs = blocks.law_inputs
        memory = {name: value.size for name, value in blocks.memory.items()}
        kept = sum(memory.values())
        self._num_made = blocks.nv + kept
        own = parts({name: size for name, (*_, size) in inputs.items()} | memory)
        self._start = np.concatenate([np.zeros(0), *map(np.ravel, blocks.memory.values())])
        self._memory = {name: own.pop(name) for name in memory}
        read = sum(size for *_, size in inputs.values())
        self._before = slice(read, read + kept)  # the law's memory, in a row
        self._is_watched = blocks.watch is not None
        self._inputs = own
        self._after = parts(memory, first=blocks.nv)
        self._detectors = list(detectors)
        looked, found = blocks.detector_inputs, blocks.detector_outputs
        if not detectors:
            looked = found = {}
        self._looks = parts(
            {name: size for name, (*_, size) in looked.items()}, first=self._before.stop
        )
        self._found = parts(
            {name: size for name, (*_, size) in found.items()}, first=self._num_made
        )
        self._cells_of = (
            [*inputs.values(), ("memory", 0, kept), *looked.values()],
            [("generalized_force", 0, blocks.nv), ("memory_after", 0, kept), *found.values()],
            [(name, 0, 1) for name in ("lost", "is_first", "watched")],
        )

    def function(self, cells: np.ndarray, places: Mapping[str, int]) -> Any:
        """A function of the number of a sample (and another argument), which returns 0 if all runs
        shall end.

        Args: the cells (n, width), and the place of each array among them.
        """
        entries = [
            np.concatenate([places[name] + first + np.arange(size) for name, first, size in group])
            for group in self._cells_of
        ]
        return KIND(functools.partial(self._called, cells, entries))

    def _called(
        self, cells: np.ndarray, entries: Sequence[np.ndarray], sample: int, other: Any
    ) -> bool:
        reads, writes, (lost, is_first, restart) = entries
        try:
            rows, made = (
                np.ascontiguousarray(cells[reads].T),
                np.full((cells.shape[1], writes.size), np.nan),
            )
            are_lost, are_first = cells[[lost, is_first]] != 0.0
            if self._is_watched:
                rows[cells[restart] != 0.0, self._before] = self._start
            for lane in range(len(self._controllers)):
                if not are_lost[lane]:
                    self.step(lane, rows[lane], made[lane], is_first=are_first[lane])
            cells[writes] = made.T
            return True
        except BaseException as error:  # Python prints and forgets what a callback raises
            self.stopped = error
            return False

    def step(self, lane: int, row: np.ndarray, made: np.ndarray, *, is_first: bool) -> None:
        """Call the law of a lane.

        Args:
          lane: its number.
          row: what it reads.
          made: gets its force and memory, or NaN: it fails.
          is_first: whether no sample was before, or a grasp since.
        """
        inputs = {name: row[part] for name, part in self._inputs.items()}
        memory = {name: row[part] for name, part in self._memory.items()}
        try:
            if self._detectors and not self._look(lane, row, made, inputs):
                return
            force, after = self._controllers[lane].step(inputs, memory, is_first=is_first)
            made[: self._blocks.nv] = force
            for name, part in self._after.items():
                made[part] = after[name]
        except Exception:  # Drake's run shows it
            made[:] = np.nan

    def _look(self, lane: int, row: np.ndarray, made: np.ndarray, inputs: dict[str, Any]) -> bool:
        """Call the detector of a lane. False: it isolates a unit."""
        detector, before = self._detectors[lane]
        looks = {name: row[part] for name, part in self._looks.items()}
        outputs, after = detector.step(looks, before, Now(0.0))
        self._detectors[lane] = detector, after
        outputs = {**outputs, "abort_request": after["abort_request"]}  # at the next sample
        for name, part in self._found.items():
            made[part] = outputs[name]
            if name in inputs:
                inputs[name] = made[part]
        return not np.any(outputs.get("isolated", ()))


class Trial(Laws):
    """Calls in two orders, with measurements along the plan. A law that keeps numbers outside its
    memory, draws random ones or reads a clock makes different results of equal calls.
    """

    def calls(self, planned: Sequence[Mapping[str, np.ndarray]]) -> str:
        """Call the laws in turns. Returns what they read and make, as JSON.

        Args: of each lane, rows of its run by the names of ``Blocks.row``.
        """
        random, made = np.random.default_rng(0), list[Any]()
        before = [self._start] * len(planned)
        for sample in range(_TRIED):
            for lane, rows in enumerate(planned):
                row = np.concatenate([self._drawn(random, rows), before[lane]])
                results = np.empty(self._num_made)
                self.step(lane, row.copy(), results, is_first=sample == 0)
                if np.isfinite(results).all():
                    before[lane] = results[self._num_made - self._start.size :]
                made.append((lane, sample == 0, row.tolist(), results.tolist()))
        return json.dumps(made)

    def repeats(self, calls: str) -> str:
        """Whether the same calls in the opposite order have the same results, as JSON."""
        for lane, is_first, row, expected in reversed(json.loads(calls)):
            results = np.empty(self._num_made)
            self.step(lane, np.array(row), results, is_first=is_first)
            if not np.array_equal(results, expected, equal_nan=True):
                return "false"
        return "true"

    def _drawn(self, random: np.random.Generator, rows: Mapping[str, np.ndarray]) -> np.ndarray:
        """Inputs of a law, off the plan by any order of magnitude."""
        nq, nv = self._blocks.nq, self._blocks.nv
        desired, other = random.choice(rows["reference"], 2)
        state = other[: nq + nv] + 10.0 ** random.uniform(-6.0, 0.0) * random.normal(size=nq + nv)
        state[:4] /= np.linalg.norm(state[:4])
        made = {
            "estimated_state": state, "desired_state": desired[: nq + nv],
            "desired_acceleration": desired[nq + nv :], "applied_force": random.normal(size=nv),
            "measurement_is_new": random.integers(2, size=nq + nv),
            "desired_frame": random.choice(rows.get("frame", np.zeros((1, 0)))),
        }  # fmt: skip
        return np.concatenate([made[name] for name in self._inputs])


def parts(sizes: Mapping[Any, int], first: int = 0) -> dict[Any, slice]:
    """The places of arrays one after the other, from a first one on."""
    ends = itertools.pairwise(itertools.accumulate(sizes.values(), initial=first))
    return {name: slice(*pair) for name, pair in zip(sizes, ends, strict=True)}
