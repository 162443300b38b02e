"""Hidden coordinates in live views."""

import pytest

from ffsm_drake.plugins.interactive.panel import watch
from ffsm_drake.plugins.meshcat.stage import start_meshcat

PORT = "model.flexible.port={position: [0, 1, 0], frequency: 1}"


@pytest.fixture(scope="module")
def meshcat():
    return start_meshcat()


@pytest.fixture
def record(run):
    return run("postcapture", "controller=tdc", "duration=0.3", PORT)


def test_a_run_to_watch_is_the_run(meshcat, record):
    watched = watch(record.scenario, meshcat=meshcat, wait=lambda seconds: None)
    assert watched.dataset["hidden_position"].equals(record.dataset["hidden_position"])
    assert meshcat.HasPath("visualizer/flexible/port")
