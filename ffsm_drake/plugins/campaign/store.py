"""The campaign's database: SQLite, one writer (the driver), one row per case and controller.

Tables: ``campaign`` (key, value: the specification, its fingerprint, the shard), ``cases``
(case_index, random_seed, one column per value), ``results`` (case_index, controller, outcome,
metrics, circumstances), ``software`` (the versions that the results refer to). The view ``runs``
joins them all: one row per run, for any SQL reader.
"""

import contextlib
import csv
import dataclasses
import datetime
import fcntl
import importlib
import itertools
import json
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ffsm_drake.common.errors import CampaignError, FfsmError, one_line
from ffsm_drake.common.files import made_folder, written_whole
from ffsm_drake.common.interrupts import unfinished
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.campaign.cases import Case
from ffsm_drake.plugins.campaign.evaluate import Batch
from ffsm_drake.plugins.campaign.rows import (
    DRAKE_OUTCOME,
    ENGINE,
    FIRST_LIMIT,
    OUTCOMES,
    Row,
    engine_columns,
    metrics_of,
    predictions_of,
    texts_of,
)
from ffsm_drake.plugins.campaign.spec import OLD_ENGINE, Spec, spec_from_json

FORMAT = 2
_APPLICATION_ID = 0x66667363  # marks the file as a campaign's
_TEXT = ("outcome", "message", "worker", FIRST_LIMIT, ENGINE, OLD_ENGINE, DRAKE_OUTCOME)
_NOTES = "CREATE TABLE campaign (key TEXT PRIMARY KEY, value TEXT)"
_CHUNK, _EXPORTED = 200, 10_000  # cases, and rows of an export, held at a time
PATIENCE = 5.0  # s to wait for another program's lock


class Store:
    """An open database. Use ``create_store`` and ``open_store``."""

    def __init__(
        self, connection: sqlite3.Connection, path: Path, spec: Spec, shard: "Shard"
    ) -> None:
        self._connection = connection
        self.path = path
        self.spec = spec
        self.shard = shard  # the part of the cases that runs into this database
        self._results = result_columns(spec)
        # columns of the view ``runs``
        self.columns = (
            *("case_index", "controller", "random_seed"), *spec.names, *self._results, "software",
        )  # fmt: skip

    @property
    def runs(self) -> int:
        """Number of runs that this database shall hold."""
        return self.shard.size(self.spec.cases) * len(self.spec.controllers)

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> Iterator[tuple[Any, ...]]:
        """The rows of any SELECT."""
        with _one_line_errors(self.path):
            yield from self._connection.execute(sql, parameters)

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """Read in the block what is stored at its start, also while a campaign runs."""
        with _one_line_errors(self.path):
            self._connection.execute("BEGIN")
        try:
            yield
        finally:
            self._connection.rollback()

    def pending(self) -> Iterator[tuple[Case, str]]:
        """Every case and controller without a row, in order; a few cases are held at a time."""
        last = -1
        chunk = "SELECT * FROM cases WHERE case_index > ? ORDER BY case_index LIMIT ?"
        stored = "SELECT case_index, controller FROM results WHERE case_index BETWEEN ? AND ?"
        while rows := list(self.query(chunk, (last, _CHUNK))):
            last = rows[-1][0]
            done = set(self.query(stored, (rows[0][0], last)))
            for case in map(self._case, filter(self.shard.holds, rows)):
                yield from (
                    (case, name) for name in self.spec.controllers if (case.index, name) not in done
                )

    def case(self, index: int) -> Case:
        """One case by its number. Raises CampaignError when there is no such case."""
        if 0 <= index < self.spec.cases:
            return self._case(
                next(self.query("SELECT * FROM cases WHERE case_index = ?", (index,)))
            )
        raise CampaignError(
            f"{self.path}: has no case {index}; there are 0 to {self.spec.cases - 1}"
        )

    def _case(self, row: Sequence[Any]) -> Case:
        index, seed, *cells = row
        values: dict[str, Any] = {}
        for name, cell in zip(self.spec.names, cells, strict=True):
            try:
                values[name] = _from_column(cell)
            except (ValueError, RecursionError) as error:
                raise self._damaged(f"{name} of case {index} is no value") from error
        return Case(index=index, seed=seed, values=values)

    def check(self) -> None:
        """Raise CampaignError unless the tables can be those of this campaign."""
        cases = next(self.query("SELECT count(*), min(case_index), max(case_index) FROM cases"))
        if cases != (self.spec.cases, 0, self.spec.cases - 1):
            raise self._damaged(
                f"it holds {counted(cases[0], 'case')}, not the {self.spec.cases} specified"
            )
        if (stored := self.num_results()) > self.runs:
            raise self._damaged(
                f"it holds {counted(stored, 'result')} of {counted(self.runs, 'run')}"
            )
        self._check_cells()

    def _check_cells(self) -> None:
        """Raise CampaignError for a cell of a wrong type, or an unknown case, outcome, ..."""
        number = "typeof({0}) NOT IN ('real', 'integer', 'null')"
        text = "typeof({0}) NOT IN ('text', 'null')"
        faults = {
            "cases": (
                "typeof(random_seed) != 'integer'",
                *(f"typeof({_quoted(name)}) IN ('blob', 'null')" for name in self.spec.names),
            ),
            "results": (
                f"outcome IS NULL OR outcome NOT IN ({_places(OUTCOMES)})",
                *((text if name in _TEXT else number).format(name) for name in self._results),
                "case_index NOT IN (SELECT case_index FROM cases)",
                "software IS NULL OR software NOT IN (SELECT id FROM software)",
                f"controller IS NULL OR controller NOT IN ({_places(self.spec.controllers)})",
            ),
        }
        given = {"cases": (), "results": (*OUTCOMES, *self.spec.controllers)}
        for table, conditions in faults.items():
            where = " OR ".join(f"({condition})" for condition in conditions)
            select = f"SELECT case_index FROM {table} WHERE {where} LIMIT 1"
            for (index,) in self.query(select, given[table]):
                raise self._damaged(f"the {table} of case {index} are not what a run stores")

    def _damaged(self, problem: str) -> CampaignError:
        return CampaignError(f"{self.path}: is damaged: {problem}")

    def sampled(self, name: str) -> list[Any]:
        """Return a sampled or derived value as the database keeps it, for every case in order."""
        return [
            row[0] for row in self.query(f"SELECT {_quoted(name)} FROM cases ORDER BY case_index")
        ]

    def add(self, batch: Batch, rows: Sequence[Row]) -> None:
        """Store the results of a batch, all or none."""
        with _one_line_errors(self.path), self._connection:
            for (case, controller), row in zip(batch, rows, strict=True):
                self._insert(case.index, controller, row)

    def _insert(self, case: int, controller: str, row: Row) -> None:
        cells = (case, controller, *map(row.get, self._results))
        values = f"{_places(cells)}, (SELECT id FROM software WHERE versions = ?)"
        self._connection.execute(
            "INSERT OR IGNORE INTO software (versions) VALUES (?)", (row["software"],)
        )
        self._connection.execute(
            f"INSERT INTO results VALUES ({values})", (*cells, row["software"])
        )

    def add_results_of(self, paths: Iterable[Path]) -> None:
        """Store all results of other databases of this campaign, all or none.

        Raises:
          CampaignError: one holds another campaign or other cases, or two hold the same run.
        """
        with _one_line_errors(self.path), self._connection:
            for path in paths:
                with open_store(path) as other:
                    self._add_results_of(other)

    def _add_results_of(self, other: "Store") -> None:
        if other.spec.fingerprint != self.spec.fingerprint:
            raise CampaignError(f"{other.path}: holds another campaign than the first database")
        cases = "SELECT * FROM cases ORDER BY case_index"
        for own, read in zip(self.query(cases), other.query(cases), strict=True):
            if own != read:
                raise CampaignError(
                    f"{other.path}: case {own[0]} has other values than in the first database"
                )
        for run in other.query("SELECT * FROM runs"):
            row = dict(zip(self.columns, run, strict=True))
            case, controller = row["case_index"], row["controller"]
            try:
                self._insert(case, controller, row)
            except sqlite3.IntegrityError:
                raise CampaignError(
                    f"{other.path}: an earlier database also holds case {case} with {controller}"
                ) from None

    def result(self, case: int, controller: str) -> dict[str, Any]:
        """Return the stored row of one run, by column of the view ``runs``. Raises CampaignError
        when it is not there yet.
        """
        for row in self.query(
            "SELECT * FROM runs WHERE case_index = ? AND controller = ?", (case, controller)
        ):
            return dict(zip(self.columns, row, strict=True))
        raise CampaignError(f"{self.path}: holds no run of case {case} with {controller}")

    def counts(self) -> dict[str, dict[str, int]]:
        """Controller -> outcome -> number of runs."""
        table = {name: dict.fromkeys(OUTCOMES, 0) for name in self.spec.controllers}
        for controller, outcome, count in self.query(
            "SELECT controller, outcome, count(*) FROM results GROUP BY 1, 2"
        ):
            table[controller][outcome] = count
        return table

    def note(self, key: str) -> str | None:
        """Return a text that ``keep`` has kept."""
        for (text,) in self.query("SELECT value FROM campaign WHERE key = ?", (key,)):
            return str(text)
        return None

    def keep(self, key: str, text: str) -> None:
        """Keep a text beside the results, unless the database cannot be written now."""
        with contextlib.suppress(sqlite3.Error), self._connection:
            self._connection.execute("INSERT OR REPLACE INTO campaign VALUES (?, ?)", (key, text))

    def num_results(self) -> int:
        return int(next(self.query("SELECT count(*) FROM results"))[0])

    def export(self, path: Path) -> None:
        """Write the view ``runs`` as CSV or Parquet, by the file's suffix; a chunk of rows is held
        at a time.

        Raises:
          CampaignError: another suffix, or ``pyarrow`` is missing.
          RecordError: the file cannot be written.
        """
        if path.suffix not in (".csv", ".parquet"):
            raise CampaignError(f"{path}: must end in .csv or .parquet")
        rows = self.query("SELECT * FROM runs ORDER BY case_index, controller")
        with written_whole(path) as temporary:
            if path.suffix == ".parquet":
                self._write_parquet(temporary, rows)
                return
            with temporary.open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow(self.columns)
                writer.writerows(rows)

    def _write_parquet(self, path: Path, rows: Iterator[tuple[Any, ...]]) -> None:
        try:
            pa: Any = importlib.import_module("pyarrow")  # optional, and without types
            pq: Any = importlib.import_module("pyarrow.parquet")
        except ImportError:
            raise CampaignError(
                "Parquet needs the extra 'parquet': pip install 'ffsm-drake[parquet]'"
            ) from None
        # The cases' values that are not numbers throughout are text.
        named = [
            name
            for name in self.spec.names
            if any(isinstance(value, str) for value in self.sampled(name))
        ]
        types = dict.fromkeys(self.columns, pa.float64())
        types |= dict.fromkeys(("case_index", "random_seed"), pa.int64())
        texts = [name for name in (*_TEXT, "controller", "software", *named) if name in types]
        types |= dict.fromkeys(texts, pa.string())
        schema = pa.schema(list(types.items()))
        with pq.ParquetWriter(path, schema) as writer:
            while chunk := list(itertools.islice(rows, _EXPORTED)):
                cells = [
                    [None if value is None else str(value) for value in column]
                    if name in texts
                    else column
                    for name, column in zip(types, zip(*chunk, strict=True), strict=True)
                ]
                writer.write_table(pa.table(cells, schema=schema))


@dataclasses.dataclass(frozen=True)
class Shard:
    """Every ``count``-th case of a campaign, from the one with index ``number`` - 1."""

    number: int = 1  # from 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Return the shard written as I/N. Raises CampaignError for other text."""
        match = re.fullmatch(r"([1-9][0-9]{0,6})/([1-9][0-9]{0,6})", text)
        if match is None or int(match[1]) > int(match[2]):
            raise CampaignError(f"--shard: must be I/N with I from 1 to N, not {text!r}")
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def holds(self, row: Sequence[Any]) -> bool:
        """Whether a row of ``cases`` belongs to it."""
        return bool(row[0] % self.count == self.number - 1)

    def size(self, cases: int) -> int:
        """Number of cases of this shard, out of the total."""
        return len(range(self.number - 1, cases, self.count))


def check_columns(spec: Spec) -> None:
    """Raise CampaignError unless every value of a case can have a column; SQL ignores case."""
    taken = dict.fromkeys(
        ("case_index", "controller", "random_seed", "software", *result_columns(spec)),
        "of the results",
    )
    for name in spec.names:
        if owner := taken.get(name.lower()):
            place = "factors." if name in spec.factors else ""
            raise CampaignError(
                f"{place}{name}: is the name of a column {owner} (case is ignored); choose another"
            )
        taken[name.lower()] = f"already, '{name}'"


@contextlib.contextmanager
def create_store(
    path: Path, spec: Spec, cases: Iterable[Case], *, shard: Shard | None = None
) -> Iterator[Store]:
    """Make a new database with all cases, to run those of ``shard`` (default: all), and hold it for
    writing; it is removed if the block fails before any result is stored.

    Raises:
      CampaignError: the file exists, or cannot be used.
      RecordError: the place cannot be written.
    """
    check_columns(spec)
    if path.exists():
        with open_store(path) as store:
            if store.spec.fingerprint != spec.fingerprint:
                raise CampaignError(
                    f"{path}: holds another campaign (fingerprint {store.spec.fingerprint[:12]}, "
                    f"not {spec.fingerprint[:12]}); choose another file with --database"
                )
        raise CampaignError(
            f"{path}: exists; finish it with 'ffsm campaign resume {path}', or choose --database"
        )
    # Filled under another name, so that a database at ``path`` always holds all cases.
    with (
        _held(path),
        _one_line_errors(path),
        written_whole(path) as temporary,
        contextlib.closing(sqlite3.connect(temporary)) as connection,
    ):
        _fill(connection, spec, cases, folder=path.parent, shard=shard or Shard())
    keep = False  # as when the disk is full
    try:
        with open_store(path, writing=True) as store:
            keep = True
            try:
                yield store
            except (FfsmError, OSError):
                keep = store.num_results() > 0
                raise
    except (FfsmError, OSError):
        if not keep:
            for suffix in ("", "-wal", "-shm", "-journal"):
                path.with_name(f"{path.name}{suffix}").unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def open_store(path: Path, *, writing: bool = False) -> Iterator[Store]:
    """Open a database; with ``writing``, hold it as its only writer.

    Raises:
      CampaignError: there is none, it is no campaign's or damaged, or another process writes to it.
    """
    if not path.is_file():
        raise CampaignError(f"{path}: no such database; 'ffsm campaign run' makes one")
    with contextlib.ExitStack() as stack:
        if writing:
            stack.enter_context(_held(path))
        stack.enter_context(_one_line_errors(path))
        connection = stack.enter_context(
            contextlib.closing(sqlite3.connect(path, timeout=PATIENCE))
        )
        store = _checked_store(connection, path)
        if writing:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            connection.execute("BEGIN IMMEDIATE")  # fails where another program holds it
            connection.rollback()
        try:
            yield store
        finally:
            # back to a single file, readable in a write-protected folder; unless others read it
            if writing:
                with contextlib.suppress(sqlite3.Error):
                    connection.execute("PRAGMA busy_timeout = 0")
                    connection.execute("PRAGMA journal_mode = DELETE")


def _checked_store(connection: sqlite3.Connection, path: Path) -> Store:
    """Return the campaign of a database. Raises CampaignError: it is none, or damaged."""
    if connection.execute("PRAGMA application_id").fetchone()[0] != _APPLICATION_ID:
        raise CampaignError(f"{path}: is not a campaign's database")
    connection.execute("PRAGMA trusted_schema = OFF")
    schema = dict(connection.execute("SELECT name, sql FROM sqlite_master"))
    triggers = "SELECT 1 FROM sqlite_master WHERE type = 'trigger'"
    foreign = f"{path}: is damaged: its tables are not a campaign's"
    # reading another view may never end, and a trigger writes
    if schema.get("campaign") != _NOTES or connection.execute(triggers).fetchone():
        raise CampaignError(foreign)
    problem = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if problem != "ok":
        raise CampaignError(f"{path}: is damaged: {' '.join(problem.split())}")
    notes = dict(connection.execute("SELECT key, value FROM campaign"))
    if notes.get("format") != str(FORMAT):
        raise CampaignError(f"{path}: format {notes.get('format')} is not the supported {FORMAT}")
    try:
        spec = spec_from_json(notes["specification"], path.parent)
        store = Store(connection, path, spec, Shard.parse(notes.get("shard", str(Shard()))))
    except (
        LookupError, TypeError, AttributeError, ValueError, RecursionError, FfsmError,
    ) as error:  # fmt: skip
        raise CampaignError(
            f"{path}: is damaged: it holds no usable specification: {one_line(error)}"
        ) from error
    if any(schema.get(name) != sql for name, sql in _schema(spec).items()):
        raise CampaignError(foreign)
    store.check()
    return store


def _schema(spec: Spec) -> dict[str, str]:
    """Return the statements that make the tables and the view of a campaign, by name."""
    values, columns = [_quoted(name) for name in spec.names], result_columns(spec)
    results = [f"{name} {'TEXT' if name in _TEXT else 'REAL'}" for name in columns]
    shown = [f"cases.{name}" for name in values] + [f"results.{name}" for name in columns]
    return {
        "campaign": _NOTES,
        "cases": "CREATE TABLE cases (case_index INTEGER PRIMARY KEY, "
        f"{', '.join(['random_seed', *values])})",
        "software": "CREATE TABLE software (id INTEGER PRIMARY KEY, versions TEXT UNIQUE)",
        "results": "CREATE TABLE results (case_index INTEGER REFERENCES cases, controller TEXT, "
        f"{', '.join(results)}, software INTEGER REFERENCES software, PRIMARY KEY (case_index, "
        "controller)) WITHOUT ROWID",
        "runs": "CREATE VIEW runs AS SELECT cases.case_index, results.controller, "
        f"cases.random_seed, {', '.join(shown)}, software.versions AS software FROM results JOIN "
        "cases USING (case_index) JOIN software ON software.id = results.software",
    }


def _fill(
    connection: sqlite3.Connection,
    spec: Spec,
    cases: Iterable[Case],
    *,
    folder: Path,
    shard: Shard,
) -> None:
    with connection:
        connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        for statement in _schema(spec).values():
            connection.execute(statement)
        notes = {
            "format": str(FORMAT),
            "specification": spec.to_json(folder),
            "fingerprint": spec.fingerprint,
            "shard": str(shard),
            "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        }
        connection.executemany("INSERT INTO campaign VALUES (?, ?)", notes.items())
        connection.executemany(
            f"INSERT INTO cases VALUES (?, ?, {_places(spec.names)})",
            ((case.index, case.seed, *map(_to_column, case.values.values())) for case in cases),
        )


@contextlib.contextmanager
def _held(path: Path) -> Iterator[None]:
    """Hold the lock of a database's only writer; it ends with the process, and its file with this
    block.
    """
    lock = path.with_name(f".{path.name}.lock")
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(made_folder(path.absolute().parent))
                file = os.open(lock, flags, 0o644)
            except OSError as error:
                raise CampaignError(f"{path}: cannot be written: {one_line(error)}") from error
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(file)
                problem = "is in use; another campaign is writing to it"
                raise CampaignError(f"{path}: {problem}") from None
            with contextlib.suppress(OSError):
                if os.path.samestat(os.stat(lock), os.fstat(file)):
                    break
            os.close(file)  # the one before has just removed it
        try:
            with unfinished(lock):
                yield
        finally:
            os.close(file)


@contextlib.contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into CampaignError."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise CampaignError(f"{path}: cannot be used: {one_line(error)}") from error
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        # the latter: its messages quote the file's bytes
        raise CampaignError(
            f"{path}: is damaged or not a campaign's database: {one_line(error)}"
        ) from error


def result_columns(spec: Spec) -> tuple[str, ...]:
    """Return the columns of a campaign's results, in their order."""
    numbers = (*metrics_of(spec), *predictions_of(spec))
    return (
        "outcome",
        "outcome_time",
        "message",
        *texts_of(spec),
        *numbers,
        *engine_columns(spec),
        "wall_time",
        "worker",
        "rss_mib",
    )


def _to_column(value: Any) -> Any:
    """Convert a value for SQLite: a number or text unchanged, anything else to JSON text.

    Text that looks like JSON is written as JSON too.
    """
    if isinstance(value, str):
        plain = not _looks_like_json(value)
    else:
        plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    return value if plain else json.dumps(value)


def _looks_like_json(text: str) -> bool:
    return text.startswith(("[", "{", '"')) or text in ("null", "true", "false")


def _from_column(value: Any) -> Any:
    """Return the inverse of _to_column."""
    return json.loads(value) if isinstance(value, str) and _looks_like_json(value) else value


def _places(values: Sequence[Any]) -> str:
    """Placeholders of values in SQL."""
    return ", ".join("?" * len(values))


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
