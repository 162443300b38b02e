"""Batches of cases: the same rows for any size, whoever is killed or stopped; the tasks in them."""

import tempfile
from pathlib import Path
from signal import SIGKILL, SIGSEGV

import pytest
from campaign_tools import HERE, forked, invoke, run_here, table, write_spec
from hypothesis import given, settings
from hypothesis import strategies as st

import ffsm_drake.plugins.campaign.run as campaign_run
from ffsm_drake.common.errors import InterruptedCampaign
from ffsm_drake.plugins.campaign.cases import Case
from ffsm_drake.plugins.campaign.evaluate import alone, batches
from ffsm_drake.plugins.campaign.rows import CIRCUMSTANCES, failure_row
from ffsm_drake.plugins.campaign.run import LONGEST, Progress, resume_campaign, start_campaign
from ffsm_drake.plugins.campaign.spec import load_spec, spec_from_data
from ffsm_drake.plugins.campaign.store import open_store
from ffsm_drake.plugins.workers.pool import Stop


@given(
    tasks=st.sets(st.tuples(st.integers(0, 20), st.sampled_from(("tdc", "asmc", "aismc")))),
    size=st.integers(1, 30),
)
def test_every_task_is_in_one_batch(tasks, size):
    cases = [Case(index=index, seed=0, values={}) for index in range(21)]
    given_tasks = [(cases[i], name) for i, name in sorted(tasks)]
    found = list(batches(iter(given_tasks), size=lambda: size))
    assert all(1 <= len(batch) <= size for batch in found)
    assert [run for batch in found for run in batch] == given_tasks
    assert [part for batch in found for part in alone(batch)] == [(run,) for run in given_tasks]


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    """A refused value among its cases: the third is an error row."""
    masses = {"distribution": "list", "values": [100.0, 60.0, -1.0, 80.0, 120.0]}
    return write_spec(
        tmp_path_factory.mktemp("spec") / "small.yaml",
        overrides={"duration": 0.05},
        parameters={
            "payload.truth.mass": masses,
            "sensing.velocity_noise": {"distribution": "log_uniform", "low": 1e-7, "high": 1e-5},
        },
        cases=5,
    )


@pytest.fixture(scope="module")
def database(spec, tmp_path_factory):
    return run_here(spec, tmp_path_factory.mktemp("database") / "one.db")


@pytest.fixture(scope="module")
def rows(database):
    return table(database)


def test_a_failing_case_is_a_row_that_fails_again(database, rows):
    said = "ScenarioError: payload.truth.mass: must be > 0 kg, not -1"
    errors = [row for row in rows if row["outcome"] == "error"]
    assert [(row["case_index"], row["message"]) for row in errors] == [(2, said), (2, said)]
    result = invoke("rerun", database, "--case", 2)
    assert result.exit_code == 0, result.output
    assert result.output.count("all values equal the stored ones, bit for bit") == 2


@pytest.mark.slow
@settings(max_examples=2, deadline=None)
@given(
    first=st.integers(1, 9),
    then=st.integers(1, 9),
    workers=st.integers(1, 2),
    stopped_after=st.integers(0, 9),
)
def test_rows_depend_on_no_batch_size_and_no_stop(spec, rows, first, then, workers, stopped_after):
    with tempfile.TemporaryDirectory() as folder:
        path, stop = Path(folder) / "x.db", Stop()

        def watch(progress):
            if progress.session >= stopped_after:
                stop.set()

        crew = forked(workers, in_flight=1)
        try:
            start_campaign(
                load_spec(spec), path, workers=crew, stop=stop, batch=first, progress=watch
            )
        except InterruptedCampaign:
            resume_campaign(path, workers=crew, batch=then)
        assert table(path) == rows
    assert len(rows) == 10


@given(seconds=st.lists(st.floats(0.0, 100.0), min_size=1, max_size=40), most=st.integers(1, 24))
def test_a_batch_takes_no_longer_than_an_interruption_may_lose(seconds, most):
    """The runs of a batch end together; a batch has one run until the time of a run is known."""
    progress = Progress(before=0, total=100)
    assert progress.next_batch(most) == 1
    for each in seconds:
        progress.add([{"outcome": "settled", "wall_time": each}])
    mean, size = sum(seconds) / len(seconds), progress.next_batch(most)
    assert 1 <= size <= most
    assert size == 1 or size * mean <= LONGEST * (1 + 1e-9)
    assert size == most or (size + 1) * mean > LONGEST * (1 - 1e-9)


def test_the_rows_say_how_many_runs_a_batch_has(spec, tmp_path, monkeypatch):
    found = {}
    for seconds in (0.0, 10.0, 40.0):
        sizes = found.setdefault(seconds, [])

        def slow(_, batch, sizes=sizes, seconds=seconds):
            sizes.append(len(batch))
            own = {**dict.fromkeys(CIRCUMSTANCES), "software": "", "wall_time": seconds}
            return [{**own, "rss_mib": 0.0, **failure_row(ValueError())} for _ in batch]

        monkeypatch.setattr(campaign_run, "evaluate", slow)
        loaded = spec_from_data({**load_spec(spec).data, "cases": 100})
        start_campaign(loaded, tmp_path / f"{seconds:g}.db", workers=HERE, batch=8)
        assert sum(sizes) == 200
    assert {seconds: max(sizes) for seconds, sizes in found.items()} == {0.0: 8, 10.0: 3, 40.0: 1}


KILLS_SOME = """
import dataclasses, faulthandler, os
from ffsm_drake import ControlLaw, gain

@dataclasses.dataclass(frozen=True, kw_only=True)
class KillsSome(ControlLaw):
    deadly: float = gain(0.0, "", "signal that ends the process", scalar=True)

    def step(self, sample, state):
        if self.deadly > 0.0:
            faulthandler.disable()
            os.kill(os.getpid(), int(self.deadly))
        return 0.0 * sample.v, state
"""


def test_only_the_cases_that_kill_their_worker_are_lost(tmp_path):
    (tmp_path / "kills_some.py").write_text(KILLS_SOME)
    law, deadly = "kills_some:KillsSome", [0.0, 0.0, SIGKILL, 0.0, 0.0, SIGSEGV, 0.0, 0.0]
    spec = load_spec(
        write_spec(
            tmp_path / "s.yaml",
            overrides={"python_path": [str(tmp_path)], "duration": 0.05},
            controllers=["tdc", law],
            parameters={
                "controllers.KillsSome.deadly": {
                    "distribution": "list",
                    "values": [float(each) for each in deadly],
                }
            },
            factors={},
            derive={},
            cases=8,
        )
    )
    start_campaign(spec, tmp_path / "x.db", workers=forked(1, in_flight=2), batch=4)
    with open_store(tmp_path / "x.db") as store:
        found = [store.result(index, law) for index in range(8)]
        assert store.counts()["tdc"]["settled"] == 8
    for row, signal in zip(found, deadly, strict=True):
        assert (row["outcome"] == "error") == (signal > 0.0)
        assert ("the worker process died each time it ran this" in row["message"]) == (signal > 0.0)
