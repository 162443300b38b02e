"""Clusters without a scheduler."""

import json

import pytest

from ffsm_drake.common.errors import WorkersError
from ffsm_drake.plugins.workers import cluster


@pytest.mark.smoke
def test_no_scheduler_there():
    pytest.importorskip("distributed")
    with (
        pytest.raises(WorkersError, match="no Dask scheduler answers there"),
        cluster.cluster_workers("tcp://127.0.0.1:9", patience=0.5),
    ):
        pass


@pytest.mark.parametrize(
    "content", ["none", "", "{", "[]", '{"address": 7}', 200_000 * " "], ids=len
)
def test_a_step_without_a_scheduler_ends_in_time(content, tmp_path, monkeypatch, capsys):
    """It says what it waits for, and what did not come."""
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    for name, value in {"NTASKS": "4", "PROCID": "2", "JOB_ID": "7"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    monkeypatch.setattr(cluster, "_SILENCE", 0.05)
    if content != "none":
        (tmp_path / "scheduler-7-0-0.json").write_text(content)
    with (
        pytest.raises(WorkersError, match=r"--slurm: no scheduler: .*scheduler-7-0-0.json within"),
        cluster.slurm_workers(patience=0.3),
    ):
        pass
    said = capsys.readouterr().err.splitlines()
    assert said == ["waiting for the scheduler, task 0 of the step, to write scheduler-7-0-0.json"]


def test_a_scheduler_that_is_gone_is_one_line(tmp_path, monkeypatch):
    """The second task of the step goes on as soon as there is an address, and tries it in time."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "scheduler-7-0-0.json"
    file.write_text(json.dumps({"address": "tcp://127.0.0.1:9"}))
    cluster._await_scheduler(file, 0.1)
