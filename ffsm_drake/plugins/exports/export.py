"""Runs and scenarios as files for other programs, by the file's ending."""

import inspect
from pathlib import Path
from typing import Any, Protocol

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.files import check_writable, written_whole
from ffsm_drake.common.registrations import Registry
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario, load_scenario

Source = RunRecord | Scenario | str | Path


class RunExporter(Protocol):
    """Writes the series of a run into a file."""

    def __call__(self, record: RunRecord, path: Path, **options: Any) -> None: ...


class ScenarioExporter(Protocol):
    """Writes what a scenario describes into a file; returns lines for the user."""

    def __call__(self, scenario: Scenario, path: Path, **options: Any) -> list[str]: ...


# By the ending of the file, without its dot.
EXPORTERS = Registry[RunExporter]("exporters")
SCENARIO_EXPORTERS = Registry[ScenarioExporter]("scenario_exporters")


def export(path: str | Path, source: Source, **options: Any) -> list[str]:
    """Write a run's series, or what a scenario describes, to a file for another program.

    Args:
      path: the file. Its ending selects an exporter, of a run (entry point group
        ``ffsm_drake.exporters``) or of a scenario (``ffsm_drake.scenario_exporters``).
      source: a record, a scenario, the folder of a run, or the name or file of a scenario.
      options: of the exporter; those that are None or False are not given.

    Returns: a line for each thing that a user should know of the file.

    Raises FfsmError: the ending or an option is unknown, a library is missing, the run lacks a
    series that the file needs, or the scenario's law cannot be exported.

    Example:
      >>> from ffsm_drake import export, load_scenario
      >>> lines = export("law.c", load_scenario("postcapture"))
      >>> lines[0]
      'law.c, law.h: the law tde_aismc in C99, double precision'
    """
    path, ending = Path(path), Path(path).suffix[1:]
    of_scenario = ending in SCENARIO_EXPORTERS.offers()
    exporters: Registry[Any] = SCENARIO_EXPORTERS if of_scenario else EXPORTERS
    if ending not in exporters.offers():
        known = (*EXPORTERS.offers(), *SCENARIO_EXPORTERS.offers())
        raise FfsmError(f"'{path}' must end in {', '.join(f'.{name}' for name in known)}")
    write = exporters.load(ending, f"'{path}'")
    given = {name: value for name, value in options.items() if value not in (None, False)}
    known_options = inspect.signature(write).parameters
    for name in given:
        if name not in known_options:
            raise FfsmError(f"--{name.replace('_', '-')}: not for a .{ending}")
    check_writable(path.parent)
    if of_scenario:
        return write(_scenario_of(source), path, **given)
    record = source if isinstance(source, RunRecord) else _record_of(source)
    with written_whole(path) as temporary:
        write(record, temporary, **given)
    return [str(path)]


def _scenario_of(source: Source) -> Scenario:
    if isinstance(source, RunRecord):
        return source.scenario
    return source if isinstance(source, Scenario) else load_scenario(source)


def _record_of(source: Any) -> RunRecord:
    if isinstance(source, Scenario):
        raise FfsmError("a file of a run's series needs a run, not a scenario")
    return RunRecord.load(Path(source))
