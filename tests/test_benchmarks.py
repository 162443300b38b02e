"""The benchmark runs, and what it compares is the same motion."""

import importlib.util
import re
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "rollout.py"


@pytest.fixture
def rollout():
    spec = importlib.util.spec_from_file_location("rollout_benchmark", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_rollout(rollout, monkeypatch, capsys):
    started = []

    def start_times(repeats, duration):  # a dozen fresh interpreters take too long for a test
        started.append((repeats, duration))
        return {"import pydrake.multibody.plant": rollout.Timing(median=2.0, minimum=1.0)}

    monkeypatch.setattr(rollout, "start_times", start_times)
    rollout.main(["--repeats", "1", "--duration", "0.2"])
    assert started == [(1, "duration=0.2")]
    printed = capsys.readouterr().out
    assert printed.startswith("postcapture, tde_aismc, 0.2 s")
    for ratio in ("b/a", "b/c"):  # the shipped arm and three others
        assert len(re.findall(rf"{ratio} \d+\.\d\d \(\d+\.\d\d\)", printed)) == 4, ratio
    # Drake and MuJoCo fly the same.
    differences = [float(number) for number in re.findall(r"\(b\) - \(c\): +(\d\.\de[-+]\d\d)", printed)]
    assert len(differences) == 4
    assert 0.0 < max(differences) < 1e-7
