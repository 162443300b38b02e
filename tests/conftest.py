"""Runs that several tests look at, computed once per process."""

import functools
import gc
import os
import signal
import sys
import traceback
from pathlib import Path

import pytest

from ffsm_drake.common.threads import ONE_THREAD

os.environ.update(ONE_THREAD)  # read when NumPy loads, below; the test processes fill the machine

from alone import rough_drawing
from children import CompletedProcess, heed_signals
from click.testing import Result
from entry_points import MISSING, is_there
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


PLUGINS = Path(__file__).with_name("plugins")
TOGETHER = {"matrix"}  # folders in it whose tests are of many plug-ins
TESTED = {path.parent.name for path in PLUGINS.glob("*/test_*.py")} - TOGETHER


def skip_without(report, path, text):
    """Report a skip where plug-ins were deleted and a text says that one is missing."""
    if MISSING.search(text) and any(not is_there(name) for name in TESTED):
        report.outcome = "skipped"
        report.longrepr = (str(path), 0, "a plug-in is not installed")


def said_by(error):
    """What an exception says, those that it came from, and commands in the frames that it left."""
    texts = []
    while error is not None:
        texts.append(str(error))
        for frame, _ in traceback.walk_tb(error.__traceback__):
            for value in frame.f_locals.values():
                if isinstance(value, Result):
                    texts += [value.output, str(value.exception)]
                elif isinstance(value, CompletedProcess):
                    texts += [str(value.stdout), str(value.stderr)]
        error = error.__cause__ or error.__context__
    return "\n".join(texts)


def pytest_runtest_setup(item):
    """The tests of a plug-in that was deleted are skipped."""
    if PLUGINS in item.path.parents:
        name = item.path.relative_to(PLUGINS).parts[0]
        if name in TESTED and not is_there(name):
            pytest.skip(f"plug-in {name} is not installed")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """A test that fails only as a plug-in was deleted is skipped."""
    report = yield
    if report.failed:
        skip_without(report, item.path, f"{report.longreprtext}\n{said_by(call.excinfo.value)}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """So are the tests of a module that cannot be imported without one."""
    report = yield
    if report.failed:
        skip_without(report, collector.path, report.longreprtext)
    return report


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
    if is_there("design"):
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
