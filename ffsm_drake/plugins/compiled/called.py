"""Laws and fault detection that are called at each control sample, between two functions of a
compiled run.

A user-supplied law must return the same for the same sample and memory, in any order of calls.
"""

import copy
import ctypes
import functools
import itertools
import json
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.plugins.compiled.blocks import Blocks, Places, laid
from ffsm_drake.plugins.compiled.parts import sizes_of
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
        self._blocks, self._controllers, self._detectors = blocks, controllers, [*detectors]
        # of each lane, what its detector remembers before the last sample
        self.remembered = [memory for _, memory in detectors]
        sizes = sizes_of(blocks.memory)
        self._start = {name: np.ravel(value) for name, value in blocks.memory.items()}
        self._inputs, self._memory = blocks.law_inputs, laid("memory", sizes)
        self._made = laid("memory_after", sizes) if blocks.called else {}
        if blocks.called:
            self._made["generalized_force"] = ("generalized_force", 0, blocks.nv)
        self._looks = blocks.detector_inputs if detectors else {}
        self._found = blocks.detector_outputs if detectors else {}

    def function(self, cells: np.ndarray, places: Mapping[str, int]) -> object:
        """A function of the number of a sample (and another argument), which returns 0 if all runs
        shall end.

        Args: the cells (n, width), and the place of each array among them.
        """
        return KIND(functools.partial(self._called, cells, places))

    def _called(
        self, cells: np.ndarray, places: Mapping[str, int], sample: int, other: object
    ) -> bool:
        def views(of: Places) -> dict[str, np.ndarray]:
            return {
                name: cells[places[cell] + first :][:size, lane]
                for name, (cell, first, size) in of.items()
            }

        try:
            for lane in range(len(self._controllers)):
                lost, is_first, restart = (
                    cells[places[name], lane] != 0.0 for name in ("lost", "is_first", "watched")
                )
                if lost:
                    continue
                inputs, looks, memory = (
                    {name: view.copy() for name, view in views(of).items()}
                    for of in (self._inputs, self._looks, self._memory)
                )
                if self._blocks.watch is not None and restart:
                    memory = copy.deepcopy(self._start)
                found = self._look(lane, looks) if self._detectors else {}
                made: Arrays = {}
                if np.any(found.get("isolated", ())):
                    found = {}
                elif self._made:
                    inputs |= {name: found[name] for name in inputs.keys() & found.keys()}
                    made = self.step(lane, inputs, memory, bool(is_first))
                for of, results in ((self._found, found), (self._made, made)):
                    for name, view in views(of).items():
                        view[:] = np.ravel(results.get(name, np.nan))
            return True
        except BaseException as error:  # Python prints and forgets what a callback raises
            self.stopped = error
            return False

    def step(self, lane: int, inputs: Arrays, memory: Arrays, is_first: bool) -> Arrays:
        """Call the law of a lane. Return its force and memory by name; nothing if it fails.

        Args: its number; what it reads; its memory; whether no sample was before, or a grasp since.
        """
        try:
            force, after = self._controllers[lane].step(inputs, memory, is_first=is_first)
            return {"generalized_force": force, **after}
        except Exception:  # Drake's run shows it
            return {}

    def _look(self, lane: int, looks: Arrays) -> Arrays:
        """Call the detector of a lane. Return what it finds."""
        detector, before = self._detectors[lane]
        try:
            outputs, after = detector.step(looks, before, Now(0.0))
        except Exception:  # as of the law
            return {"isolated": np.ones(1)}
        self._detectors[lane], self.remembered[lane] = (detector, after), before
        outputs = {**outputs, "abort_request": after["abort_request"]}  # at the next sample
        return {name: np.array(values, float) for name, values in outputs.items()}


class Trial(Laws):
    """Calls in two orders, with measurements along the plan. A law that keeps numbers outside its
    memory, draws random ones or reads a clock makes different results of equal calls.
    """

    def calls(self, planned: Sequence[Mapping[str, np.ndarray]]) -> str:
        """Call the laws in turns. Returns what they read and make, as JSON.

        Args: of each lane, rows of its run by the names of ``Blocks.row``.
        """
        random, made = np.random.default_rng(0), list[object]()
        before = [self._start] * len(planned)
        for sample in range(_TRIED):
            for lane, rows in enumerate(planned):
                given = lane, self._drawn(random, rows), before[lane], sample == 0
                results = copy.deepcopy(self.step(*copy.deepcopy(given)))
                if results and all(np.isfinite(values).all() for values in results.values()):
                    before[lane] = {name: results[name] for name in self._start}
                made.append((given, results))
        return _as_json(made)

    def repeats(self, calls: str) -> str:
        """Whether the same calls in the opposite order have the same results, as JSON."""
        for (lane, *of, is_first), expected in reversed(json.loads(calls)):
            inputs, memory = ({name: np.array(own) for name, own in each.items()} for each in of)
            if _as_json(self.step(lane, inputs, memory, is_first)) != json.dumps(expected):
                return "false"
        return "true"

    def _drawn(self, random: np.random.Generator, rows: Mapping[str, np.ndarray]) -> Arrays:
        """Inputs of a law, off the plan by any order of magnitude."""
        nq, nv = self._blocks.nq, self._blocks.nv
        desired, other = random.choice(rows["reference"], 2)
        state = other[: nq + nv] + 10.0 ** random.uniform(-6.0, 0.0) * random.normal(size=nq + nv)
        state[:4] /= np.linalg.norm(state[:4])
        made = {
            "estimated_state": state, "desired_state": desired[: nq + nv],
            "desired_acceleration": desired[nq + nv :], "applied_force": random.normal(size=nv),
            "measurement_is_new": 1.0 * random.integers(2, size=nq + nv),
            "desired_frame": random.choice(rows.get("frame", np.zeros((1, 0)))),
        }  # fmt: skip
        return {name: made[name] for name in self._inputs}


_as_json = functools.partial(json.dumps, default=np.ndarray.tolist)


def parts(sizes: Mapping[str, int], first: int = 0) -> dict[str, slice]:
    """The places of arrays one after the other, from a first one on."""
    ends = itertools.pairwise(itertools.accumulate(sizes.values(), initial=first))
    return {name: slice(*pair) for name, pair in zip(sizes, ends, strict=True)}
