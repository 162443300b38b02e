"""Runs that several tests look at, computed once per process."""

import functools
import gc
import os
import signal
import sys
from pathlib import Path

import pytest

from ffsm_drake.common.workers import ONE_THREAD

os.environ.update(ONE_THREAD)  # read when NumPy loads, below; the test processes fill the machine

from alone import rough_drawing
from children import heed_signals
from hypothesis import settings

from ffsm_drake import RunRecord, load_scenario, simulate

# The same examples on every machine; `pytest --hypothesis-profile default` draws others.
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")

heed_signals()  # in every worker

EXAMPLES = str(Path(__file__).parents[1] / "examples")


def pytest_configure(config):
    # figures and diagrams are many objects: collecting less often saves a tenth of the time
    gc.set_threshold(100_000)
    # Tests run unstable loops on purpose. (Not in pyproject.toml, where it would load NumPy before
    # the lines above.)
    config.addinivalue_line("filterwarnings", "ignore::ffsm_drake.runs.simulate.StabilityWarning")


def pytest_collection_finish():
    """What is imported by now stays: no collection looks through it again."""
    gc.collect()
    gc.freeze()


# The modules that take longest among the quick or the slow tests, by processor time; the longest
# starts first, so that no worker ends alone with one.
LONGEST = (
    "matrix",
    "verdict_cases",
    "golden",
    "batches",
    "bad_inputs",
    "reproduction",
    "example",
    "planning",
    "flight",
    "approach",
    "remedies",
    "user_controllers",
    "design",
    "first_mission",
    "rehearsal",
    "cli",
    "campaign_run",
    "beyond_limits",
    "replay",
    "free_planning",
    "door",
    "lifetime",
    "parts",
    "task_space",
    "verdict_cost",
    "fault_detection",
    "audit",
)


def pytest_collection_modifyitems(items):
    order = {f"test_{name}.py": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.fixture(autouse=True)
def no_handler_stays():
    """Some libraries take hold of Ctrl-C when they are imported."""
    before = signal.getsignal(signal.SIGINT)
    yield
    if signal.getsignal(signal.SIGINT) is not before:
        signal.signal(signal.SIGINT, before)


@functools.cache
def _run(name: str, *overrides: str) -> RunRecord:
    return simulate(load_scenario(name, overrides), check_stability=False)


@pytest.fixture
def rough_pictures():
    """Pictures of few pixels: where only that they are drawn counts."""
    with rough_drawing():
        yield


@pytest.fixture
def no_remedies(monkeypatch):
    """Leave out the search for what helps a mission that fails; its own tests have it."""
    monkeypatch.setattr("ffsm_drake.plugins.design.verdict.remedies", lambda *_, **__: ())


@pytest.fixture
def few_delays(monkeypatch):
    """Margins of a delay of at most two further samples: each is of a larger loop."""
    for part in ("stability.boundaries", "gains.requirement"):
        monkeypatch.setattr(f"ffsm_drake.plugins.design.{part}.LARGEST_DELAY", 2)


@pytest.fixture(autouse=True)
def no_user_module_stays(tmp_path_factory):
    """A test's own modules are unloaded after it: the next test may use their names."""
    before = set(sys.modules)
    yield
    folders = (str(tmp_path_factory.getbasetemp()), EXAMPLES)
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(folders):
            del sys.modules[name]


@pytest.fixture(scope="session")
def run():
    """run(scenario, *overrides) -> RunRecord; the same arguments give the same record."""
    return _run
