"""Whatever fails beside a record leaves the record, and one line says what was not made."""

import errno
import os

import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import RunRecord
from ffsm_drake.cli import main
from ffsm_drake.common.registrations import Registry
from ffsm_drake.runs.judge import JUDGES

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
FAILURES = (
    MemoryError("Unable to allocate 4.58 MiB"), MemoryError(), RecursionError("too deep"),
    OSError(errno.ENOSPC, "No space left on device"), SystemExit("condition 'n' failed."),
    ImportError("libjpeg.so: failed to map segment"), KeyError("font"), ValueError("x\ny"),
    RuntimeError("NetCDF: HDF error"), AssertionError(),
)  # fmt: skip
STEPS = {
    "runs.exceeded_limits.run_remarks": "remarks",
    "runs.exceeded_limits.run_clearance": "closest approach",
    "runs.exceeded_limits.broken_limits": "conclusion",
    "show.tables.results_table": "table",
    "show.outputs.write_outputs": "report",
    "runs.record.compute_metrics": "metrics.json",
}
JUDGED = {"advice": "remarks", "remedy": "remedy"}
BROUGHT = {**JUDGED, "reports": "report", "recordings": "report"}


@pytest.mark.slow
@pytest.mark.parametrize("step", [*STEPS, *BROUGHT])
def test_a_step_that_fails_leaves_the_record(step, tmp_path, monkeypatch):
    for seed in range(DRAWS):
        random = np.random.default_rng([seed, len(step)])
        failure = FAILURES[random.integers(len(FAILURES))]
        check(step, failure, tmp_path / str(seed), monkeypatch)


def check(step, failure, folder, monkeypatch):
    def fail(*_, **__):
        raise failure

    find = Registry.find
    with monkeypatch.context() as patched:
        if step in STEPS:
            patched.setattr(f"ffsm_drake.{step}", fail)
        elif step in JUDGED:
            patched.setattr(JUDGES.only("the test"), step, fail)
        else:
            patched.setattr(
                Registry,
                "find",
                lambda registry, name: fail if registry.group == step else find(registry, name),
            )
        pictures = [] if (STEPS | BROUGHT)[step] == "report" else ["--no-report"]
        line = ["run", "--set", "duration=0.05", "--out", str(folder), *pictures]
        result = CliRunner().invoke(main, line)
    assert isinstance(result.exception, SystemExit), result.exception
    said = [each for each in result.stderr.splitlines() if " not made: " in each]
    assert any(f"{(STEPS | BROUGHT)[step]} not made: " in each for each in said), result.stderr
    errors = [each for each in said if each.startswith("error: ")]
    assert result.exit_code == (2 if errors else 0)
    assert len(errors) < 2
    assert all(str(folder) in each for each in errors)
    record = RunRecord.load(folder)
    assert record.dataset.sizes["time"] == 6
    assert record.metrics["itae"] > 0.0


@pytest.mark.parametrize("value", ["x", "-1", "1e9", " ", "1.5"])
def test_a_setting_that_numpy_cannot_use_is_refused_before_the_run(value, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", value)
    result = CliRunner().invoke(main, ["run"])
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: SOURCE_DATE_EPOCH: must be whole seconds since 1970")
