"""Batches of cases: the same rows for any size, whoever is killed or stopped; the tasks in them."""

import tempfile
from pathlib import Path

import pytest
from campaign_tools import HERE, forked, run_here, table, write_spec
from hypothesis import given, settings
from hypothesis import strategies as st

import ffsm_drake.plugins.campaign.run as campaign_run
from ffsm_drake.common.errors import InterruptedCampaign
from ffsm_drake.common.workers import Stop
from ffsm_drake.plugins.campaign.cases import Case
from ffsm_drake.plugins.campaign.evaluate import CIRCUMSTANCES, batches, error_row
from ffsm_drake.plugins.campaign.run import LONGEST, BatchSizes, resume_campaign, start_campaign
from ffsm_drake.plugins.campaign.spec import load_spec, spec_from_data
from ffsm_drake.plugins.campaign.store import open_store


@given(
    tasks=st.sets(st.tuples(st.integers(0, 20), st.sampled_from(("tdc", "asmc", "aismc")))),
    size=st.integers(1, 30),
)
def test_every_task_is_in_one_batch(tasks, size):
    cases = [Case(index=index, seed=0, values={}) for index in range(21)]
    given_tasks = [(cases[i], name) for i, name in sorted(tasks)]
    found = list(batches(iter(given_tasks), size=lambda: size))
    assert all(1 <= len(batch.runs) <= size for batch in found)
    made = [run for batch in found for run in batch.runs]
    assert made == given_tasks
    assert [part.runs for batch in found for part in batch.parts] == [(run,) for run in made]


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
def rows(spec, tmp_path_factory):
    return table(run_here(spec, tmp_path_factory.mktemp("database") / "one.db"))


@pytest.mark.slow
@settings(max_examples=2, deadline=None)
@given(
    first=st.integers(1, 9),
    then=st.integers(1, 9),
    workers=st.integers(1, 2),
    stopped_after=st.integers(1, 9),
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
    assert sum(row[3] == "error" for row in rows) == 2


@given(seconds=st.lists(st.floats(0.0, 100.0), min_size=1, max_size=40), most=st.integers(1, 24))
def test_a_batch_takes_no_longer_than_an_interruption_may_lose(seconds, most):
    """The runs of a batch end together; a batch has one run until the time of a run is known."""
    sizes = BatchSizes(most)
    assert sizes() == 1
    for each in seconds:
        sizes.add([{"wall_time": each}])
    mean = sum(seconds) / len(seconds)
    assert 1 <= sizes() <= most
    assert sizes() == 1 or sizes() * mean <= LONGEST * (1 + 1e-9)
    assert sizes() == most or (sizes() + 1) * mean > LONGEST * (1 - 1e-9)


def test_the_rows_say_how_many_runs_a_batch_has(spec, tmp_path, monkeypatch):
    found = {}
    for seconds in (0.0, 10.0, 40.0):
        sizes = found.setdefault(seconds, [])

        def slow(_, batch, sizes=sizes, seconds=seconds):
            sizes.append(len(batch.runs))
            own = {**dict.fromkeys(CIRCUMSTANCES), "software": "", "wall_time": seconds}
            return [{**own, "rss_mib": 0.0, **error_row("x")} for _ in batch.runs]

        monkeypatch.setattr(campaign_run, "evaluate", slow)
        loaded = spec_from_data({**load_spec(spec).data, "cases": 100})
        start_campaign(loaded, tmp_path / f"{seconds:g}.db", workers=HERE, batch=8)
        assert sum(sizes) == 200
    assert {seconds: max(sizes) for seconds, sizes in found.items()} == {0.0: 8, 10.0: 3, 40.0: 1}


KILLS_SOME = """
import dataclasses, os, signal
from ffsm_drake import ControlLaw
from ffsm_drake.systems.controllers.law import gain

@dataclasses.dataclass(frozen=True, kw_only=True)
class KillsSome(ControlLaw):
    deadly: float = gain(0.0, "", "ends the process if positive", scalar=True)

    def step(self, sample, state):
        if self.deadly > 0.0:
            os.kill(os.getpid(), signal.SIGKILL)
        return 0.0 * sample.v, state
"""


def test_only_the_case_that_kills_its_worker_is_lost(tmp_path):
    (tmp_path / "kills_some.py").write_text(KILLS_SOME)
    law = "kills_some:KillsSome"
    deadly = {"distribution": "list", "values": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]}
    spec = load_spec(
        write_spec(
            tmp_path / "s.yaml",
            overrides={"python_path": [str(tmp_path)], "duration": 0.05},
            controllers=["tdc", law],
            parameters={"controllers.KillsSome.deadly": deadly},
            factors={},
            derive={},
            cases=8,
        )
    )
    start_campaign(spec, tmp_path / "x.db", workers=forked(1, in_flight=1), batch=4)
    with open_store(tmp_path / "x.db") as store:
        messages = [store.result(index, law)["message"] for index in range(8)]
        assert store.num_results() == 16
    assert "the worker process died each time" in messages[2]
    assert not any("died" in message for k, message in enumerate(messages) if k != 2)
