"""The campaign's database: SQLite, one writer (the driver), one row per case and controller.

Tables: ``campaign`` (key, value: the specification and its fingerprint), ``cases`` (case_index, random_seed, one column
per value), ``results`` (case_index, controller, outcome, metrics, circumstances), ``software`` (the versions that the
results refer to). The view ``runs`` joins them all: one row per run, for any SQL reader.
"""

import contextlib
import csv
import datetime
import fcntl
import importlib
import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from ffsm_drake.campaign.cases import Case
from ffsm_drake.campaign.errors import CampaignError
from ffsm_drake.campaign.evaluate import METRICS, OUTCOMES, PREDICTIONS, Row
from ffsm_drake.campaign.spec import Spec, spec_from_json
from ffsm_drake.common.errors import RecordError, one_line
from ffsm_drake.common.files import written_whole

FORMAT = 1
_APPLICATION_ID = 0x66667363  # what makes the file one of ours
_RESULT = ("outcome", "outcome_time", "message", *METRICS, *PREDICTIONS, "wall_time", "worker", "rss_mib")
_TEXT = ("outcome", "message", "worker")
_CHUNK = 200  # rows held at a time
_PATIENCE = 5.0  # s to wait for another program's lock


class Store:
    """An open database. Use ``create_store`` and ``open_store``."""

    def __init__(self, connection: sqlite3.Connection, path: Path, spec: Spec) -> None:
        self._connection = connection
        self.path = path
        self.spec = spec

    def pending(self) -> Iterator[tuple[Case, str]]:
        """Every case and controller without a row, in order; a few cases are held at a time."""
        last = -1
        while True:
            with _told(self.path):
                rows = self._connection.execute(
                    "SELECT * FROM cases WHERE case_index > ? ORDER BY case_index LIMIT ?", (last, _CHUNK)
                ).fetchall()
                if not rows:
                    return
                done = set(
                    self._connection.execute(
                        "SELECT case_index, controller FROM results WHERE case_index BETWEEN ? AND ?",
                        (rows[0][0], rows[-1][0]),
                    )
                )
            for row in rows:
                case = self._case(row)
                yield from (
                    (case, controller) for controller in self.spec.controllers if (case.index, controller) not in done
                )
            last = rows[-1][0]

    def case(self, index: int) -> Case:
        """One case by its number. Raises CampaignError when there is no such case."""
        with _told(self.path):
            row = self._connection.execute("SELECT * FROM cases WHERE case_index = ?", (index,)).fetchone()
        if row is None:
            raise CampaignError(f"{self.path}: has no case {index}; there are 0 to {self.spec.cases - 1}")
        return self._case(row)

    def _case(self, row: Sequence[Any]) -> Case:
        index, seed, *values = row
        return Case(index=index, seed=seed, values=dict(zip(self.spec.names, map(_from_column, values), strict=True)))

    def add(self, rows: Iterable[tuple[Case, str, Row]]) -> None:
        """Store results in one transaction."""
        with _told(self.path), self._connection:
            for case, controller, row in rows:
                software = self._software(row["software"])
                self._connection.execute(
                    f"INSERT INTO results VALUES ({', '.join('?' * (3 + len(_RESULT)))})",
                    (case.index, controller, *(row[name] for name in _RESULT), software),
                )

    def _software(self, text: str) -> int:
        self._connection.execute("INSERT OR IGNORE INTO software (versions) VALUES (?)", (text,))
        return int(self._connection.execute("SELECT id FROM software WHERE versions = ?", (text,)).fetchone()[0])

    def result(self, case: int, controller: str) -> dict[str, Any]:
        """The stored row of one run, by column of the view ``runs``. Raises CampaignError when it is not there yet."""
        with _told(self.path):
            cursor = self._connection.execute(
                "SELECT * FROM runs WHERE case_index = ? AND controller = ?", (case, controller)
            )
            row = cursor.fetchone()
        if row is None:
            raise CampaignError(f"{self.path}: holds no run of case {case} with {controller}")
        return dict(zip((column[0] for column in cursor.description), row, strict=True))

    def counts(self) -> dict[str, dict[str, int]]:
        """Controller -> outcome -> number of runs."""
        table = {name: dict.fromkeys(OUTCOMES, 0) for name in self.spec.controllers}
        for controller, outcome, count in self.query("SELECT controller, outcome, count(*) FROM results GROUP BY 1, 2"):
            table[controller][outcome] = count
        return table

    def num_results(self) -> int:
        return int(next(self.query("SELECT count(*) FROM results"))[0])

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> Iterator[tuple[Any, ...]]:
        """The rows of any SELECT."""
        with _told(self.path):
            yield from self._connection.execute(sql, parameters)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the view ``runs``."""
        with _told(self.path):
            return tuple(item[0] for item in self._connection.execute("SELECT * FROM runs LIMIT 0").description)

    def export(self, path: Path) -> None:
        """Write the view ``runs`` as CSV or Parquet, by the file's suffix; a chunk of rows is held at a time.

        Raises:
          CampaignError: another suffix, ``pyarrow`` is missing, or the file cannot be written.
        """
        writers = {".csv": self._write_csv, ".parquet": self._write_parquet}
        if path.suffix not in writers:
            raise CampaignError(f"{path}: must end in {' or '.join(writers)}")
        try:
            with written_whole(path) as temporary:
                writers[path.suffix](temporary)
        except RecordError as error:
            raise CampaignError(one_line(error)) from error

    def _write_csv(self, path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(self.columns)
            writer.writerows(self.query("SELECT * FROM runs ORDER BY case_index, controller"))

    def _write_parquet(self, path: Path) -> None:
        try:
            pa: Any = importlib.import_module("pyarrow")  # optional, and without types
            pq: Any = importlib.import_module("pyarrow.parquet")
        except ImportError:
            raise CampaignError("Parquet needs the extra 'campaign': pip install 'ffsm-drake[campaign]'") from None
        texts = {*_TEXT, "controller", "software", *self._text_values()}
        whole = {"case_index", "random_seed"}
        schema = pa.schema(
            [
                (name, pa.string() if name in texts else pa.int64() if name in whole else pa.float64())
                for name in self.columns
            ]
        )
        rows = self.query("SELECT * FROM runs ORDER BY case_index, controller")
        with pq.ParquetWriter(path, schema) as writer:
            for chunk in _chunks(rows, 50 * _CHUNK):
                columns = [
                    [None if value is None else str(value) for value in column] if name in texts else column
                    for name, column in zip(self.columns, zip(*chunk, strict=True), strict=True)
                ]
                writer.write_table(pa.table(columns, schema=schema))

    def _text_values(self) -> list[str]:
        """The names of the cases' values that are not numbers throughout."""
        return [
            name
            for name in self.spec.names
            if next(self.query(f"SELECT count(*) FROM cases WHERE typeof({_quoted(name)}) NOT IN ('real', 'integer')"))[
                0
            ]
        ]


@contextlib.contextmanager
def create_store(path: Path, spec: Spec, cases: Iterable[Case]) -> Iterator[Store]:
    """Make a new database with all cases, and hold it for writing.

    Raises:
      CampaignError: the file exists, or the place cannot be written.
    """
    if taken := {*spec.names} & {"case_index", "controller", "random_seed", "software", *_RESULT}:
        raise CampaignError(f"factors.{min(taken)}: is the name of a column of the results; choose another")
    if path.exists():
        with open_store(path) as store:
            if store.spec.fingerprint != spec.fingerprint:
                raise CampaignError(
                    f"{path}: holds another campaign (fingerprint {store.spec.fingerprint[:12]}, not "
                    f"{spec.fingerprint[:12]}); choose another file with --database"
                )
        raise CampaignError(f"{path}: exists; finish it with 'ffsm campaign resume {path}', or choose --database")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CampaignError(f"{path}: cannot be written: {one_line(error)}") from error
    # Filled under another name: a database that is there is whole.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with _held(path):
        try:
            with _told(path), contextlib.closing(_connect(temporary)) as connection:
                _fill(connection, spec, cases)
            temporary.replace(path)
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink()
        with _told(path), contextlib.closing(_connect(path)) as connection:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            yield Store(connection, path, spec)


@contextlib.contextmanager
def open_store(path: Path, *, writing: bool = False) -> Iterator[Store]:
    """Open a database; with ``writing``, hold it as its only writer.

    Raises:
      CampaignError: there is none, it is no campaign's or damaged, or somebody else writes to it.
    """
    if not path.is_file():
        raise CampaignError(f"{path}: no such database; 'ffsm campaign run' makes one")
    with _held(path) if writing else contextlib.nullcontext():  # noqa: SIM117
        with _told(path), contextlib.closing(_connect(path)) as connection:
            if connection.execute("PRAGMA application_id").fetchone()[0] != _APPLICATION_ID:
                raise CampaignError(f"{path}: is not a campaign's database")
            problem = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
            if problem != "ok":
                raise CampaignError(f"{path}: is damaged: {' '.join(problem.split())}")
            notes = dict(connection.execute("SELECT key, value FROM campaign"))
            if notes.get("format") != str(FORMAT):
                raise CampaignError(f"{path}: format {notes.get('format')} is not the supported {FORMAT}")
            spec = spec_from_json(notes["specification"])
            if writing:
                connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("PRAGMA synchronous = NORMAL")
                connection.execute("BEGIN IMMEDIATE")  # whether anybody else holds it
                connection.rollback()
            yield Store(connection, path, spec)


def _connect(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(path, timeout=_PATIENCE)


def _fill(connection: sqlite3.Connection, spec: Spec, cases: Iterable[Case]) -> None:
    values = [_quoted(name) for name in spec.names]
    results = [f"{name} {'TEXT' if name in _TEXT else 'REAL'}" for name in _RESULT]
    shown = [*(f"cases.{name}" for name in values), *(f"results.{name}" for name in _RESULT)]
    with connection:
        connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        connection.execute("CREATE TABLE campaign (key TEXT PRIMARY KEY, value TEXT)")
        connection.execute(
            f"CREATE TABLE cases (case_index INTEGER PRIMARY KEY, {', '.join(['random_seed', *values])})"
        )
        connection.execute("CREATE TABLE software (id INTEGER PRIMARY KEY, versions TEXT UNIQUE)")
        connection.execute(
            f"CREATE TABLE results (case_index INTEGER REFERENCES cases, controller TEXT, {', '.join(results)}, "
            "software INTEGER REFERENCES software, PRIMARY KEY (case_index, controller)) WITHOUT ROWID"
        )
        connection.execute(
            f"CREATE VIEW runs AS SELECT cases.case_index, controller, random_seed, {', '.join(shown)}, "
            "versions AS software FROM results JOIN cases USING (case_index) "
            "JOIN software ON software.id = results.software"
        )
        notes = {
            "format": str(FORMAT),
            "specification": spec.to_json(),
            "fingerprint": spec.fingerprint,
            "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        }
        connection.executemany("INSERT INTO campaign VALUES (?, ?)", notes.items())
        connection.executemany(
            f"INSERT INTO cases VALUES ({', '.join('?' * (2 + len(values)))})",
            ((case.index, case.seed, *map(_to_column, case.values.values())) for case in cases),
        )


@contextlib.contextmanager
def _held(path: Path) -> Iterator[None]:
    """Be the only driver of a database, through a lock that ends with the process."""
    file: IO[str]
    try:
        file = path.with_name(f".{path.name}.lock").open("w", encoding="utf-8")
    except OSError as error:
        raise CampaignError(f"{path}: cannot be written: {one_line(error)}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise CampaignError(f"{path}: is in use; another campaign is writing to it") from None
        yield


@contextlib.contextmanager
def _told(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into one line."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise CampaignError(f"{path}: cannot be used: {one_line(error)}") from error
    except sqlite3.DatabaseError as error:
        raise CampaignError(f"{path}: is damaged or not a campaign's database: {one_line(error)}") from error


def _to_column(value: Any) -> Any:
    """A value as SQLite keeps it: numbers and text as they are, all else as JSON text."""
    return value if isinstance(value, (int, float, str)) and not isinstance(value, bool) else json.dumps(value)


def _from_column(value: Any) -> Any:
    """The inverse of _to_column: no text value of a scenario looks like JSON."""
    if isinstance(value, str) and (value.startswith(("[", "{")) or value in ("null", "true", "false")):
        return json.loads(value)
    return value


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _chunks(rows: Iterator[tuple[Any, ...]], size: int) -> Iterator[list[tuple[Any, ...]]]:
    chunk: list[tuple[Any, ...]] = []
    for row in rows:
        chunk.append(row)
        if len(chunk) == size:
            yield chunk
            chunk = []
    if chunk:
        yield chunk


def as_columns(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> Mapping[str, list[Any]]:
    """Rows turned into columns."""
    columns: dict[str, list[Any]] = {name: [] for name in names}
    for row in rows:
        for name, value in zip(names, row, strict=True):
            columns[name].append(value)
    return columns
