"""What a plug-in expects of a mission, and what it advises after a run."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Override, Scenario


class Judge(Protocol):
    """Judges missions. The functions of a mission raise the errors of its plan and its loop."""

    def remarks(self, mission: Mission) -> list[str]:
        """Return a line for each limit that the plan exceeds, and for each changed mass."""

    def warnings(self, mission: Mission) -> Iterable[str]:
        """Return why a mission is not expected to go as planned, without a rehearsal."""

    def validate(self, scenario: Scenario, *, rehearsal: bool) -> tuple[dict[str, Any], list[str]]:
        """Return all that is expected of a mission for ``ffsm validate``: plain data, whose
        ``warnings`` are lines, and other lines.
        """

    def layers(self, name: str, overrides: Iterable[Override]) -> Iterable[str]:
        """Return a line for sensors that were given for another sample time than the scenario's.

        Args: the name or file of a scenario that loads, and its overrides.
        """

    def uncovered(self, mission: Mission, law: Any) -> str:
        """Return a line on what of a law's adaptation the analyses do not cover; or "".

        Raises BlockError: the law fails.
        """

    def distance(self, mission: Mission) -> float:
        """Return the distance of the controller to the LQG limit, 1: at the limit."""

    def advice(self, record: RunRecord) -> list[str]:
        """Return lines with what helps a run that failed or saturated its actuators."""

    def remedy(self, record: RunRecord, directory: Path) -> Path | None:
        """Write a changed scenario into the folder of a run; return the file. None: no remedy.

        Raises RecordError: the file cannot be written.
        """


JUDGES = Registry[Judge]("judges")
