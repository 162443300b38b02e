"""Plans of supervisors, made within a compiled run at the samples that ask for one."""

import functools
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.plugins.compiled.called import KIND, parts
from ffsm_drake.plugins.compiled.parameters import rows_of
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.plugins.compiled.supervising import Supervisor
from ffsm_drake.systems.controllers.law import ControlLaw


def plans_of(runs: Sequence[Run]) -> "Plans | None":
    """Return the plans of runs with the same code; None: they have no supervisor."""
    found = [made for run in runs if (made := run.case.made.supervisor) is not None]
    return Plans(found, [run.law for run in runs]) if found else None


class Plans:
    """The supervisors of the first lanes of a register."""

    def __init__(self, supervisors: Sequence[Supervisor], laws: Sequence[ControlLaw]) -> None:
        """Args: of each lane its supervisor, with a ``block`` and ``answered``, and its law."""
        self.stopped: BaseException | None = None  # what ended the runs
        self._supervisors, self._laws = supervisors, laws
        self._memory = parts(
            {name: each.size for name, each in supervisors[0].block.start().items()}
        )

    def function(
        self,
        cells: np.ndarray,
        places: Mapping[str, int],
        rows: Sequence[Mapping[str, np.ndarray]],
        begun: Sequence[int],
    ) -> object:
        """A function of the number of a sample (and another argument), which returns 0 if all runs
        must end.

        Args: the cells (n, width), and the place of each array among them; the rows that
          each lane reads, into which its plan is written; and the sample of the run at row 0.
        """
        watched = cells[places["watched"] :]  # a view
        for lane, first in enumerate(begun):
            plan = watched[self._memory["plan"], lane]
            if plan[1] > 0.0:
                self._follow(lane, plan, rows[lane], first)
        return KIND(functools.partial(self._asked, cells, places, rows, begun))

    def _asked(
        self,
        cells: np.ndarray,
        places: Mapping[str, int],
        rows: Sequence[Mapping[str, np.ndarray]],
        begun: Sequence[int],
        sample: int,
        other: object,
    ) -> bool:
        try:
            for lane in np.flatnonzero(cells[places["asks"]]).tolist():
                own = {name: cells[place:, lane] for name, place in places.items()}  # views
                if lane < len(begun):
                    self._answer(lane, own, rows[lane], begun[lane], sample)
                else:  # it has no run
                    own["watched"][self._memory["answer"]] = 2.0
            return True
        except BaseException as error:  # Python prints and forgets what a callback raises
            self.stopped = error
            return False

    def _answer(
        self,
        lane: int,
        own: Mapping[str, np.ndarray],
        rows: Mapping[str, np.ndarray],
        begun: int,
        sample: int,
    ) -> None:
        """Write the answer to a lane into its cells, and what follows into its rows."""
        supervisor = self._supervisors[lane]
        memory = {name: own["watched"][part].copy() for name, part in self._memory.items()}
        measured = own["measurement"][: memory["held"].size].copy()
        time = (begun + sample) * supervisor.block.sample_time
        if own["asks"][0] == 1.0:
            memory = supervisor.answered(memory, measured, time)
        else:
            memory["answer"][:] = 2.0
        for name, part in self._memory.items():
            own["watched"][part] = memory[name]
        after = {name: values[sample + 1 :] for name, values in rows.items()}
        if memory["answer"] == 1.0:
            self._follow(lane, memory["plan"], after, begun + sample + 1)
            modes = np.ravel(supervisor.block.modes(np.array([time]), memory["plan"]))
            own["phases"][: rows["phases"].shape[1]][-modes.size :] = modes
        elif "planned" in rows:
            nq = supervisor.mission.craft.coordinates.num_positions
            after["planned"][:1] = rows_of(self._laws[lane], measured[None, :nq])

    def _follow(
        self, lane: int, plan: np.ndarray, rows: Mapping[str, np.ndarray], first: int
    ) -> None:
        """Let a lane read a plan, from the sample ``first`` on."""
        supervisor, law = self._supervisors[lane], self._laws[lane]
        step, block = supervisor.block.sample_time, supervisor.block
        since = first - round(plan[0] / step) + np.arange(len(rows["reference"]))
        for name, motion in zip(("reference", "frame"), supervisor.motions(plan), strict=False):
            rows[name][:] = motion.rows(step * since)
        modes = np.transpose(block.modes(plan[0] + step * since, plan))
        rows["phases"][:, -modes.shape[1] :] = modes
        if "planned" in rows:
            nq = supervisor.mission.craft.coordinates.num_positions
            rows["planned"][:] = rows_of(law, rows["reference"][:, :nq])
