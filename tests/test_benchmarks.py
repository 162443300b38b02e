"""The benchmark runs, and what it compares is the same motion."""

import importlib
import importlib.util
import re
from pathlib import Path

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
ON_BASILISK = importlib.util.find_spec("Basilisk") is not None


def test_rollout(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    rollout = importlib.import_module("rollout")
    rollout.main(["--repeats", "1", "--duration", "0.2"])
    printed = capsys.readouterr().out
    assert printed.startswith("postcapture, tde_aismc, 0.2 s")
    ratio = r"\d+\.\d\d \(\d+\.\d\d\)"
    others = ["a", "c", *(["d"] if ON_BASILISK else [])]
    # several runs at once are runs
    (of_all,) = re.findall(r"of all runs, largest difference \(b\) - \(e\): (\S+)", printed)
    assert 0.0 < float(of_all) < 1e-7
    assert len(re.findall(rf"e/a {ratio}   b/e {ratio}", printed)) == 1
    for other in others:
        # the shipped arm and three others
        assert len(re.findall(rf"b/{other} {ratio}", printed)) == 4, other
    assert ("skipped, needs 'pip install bsk'" in printed) != ON_BASILISK
    # Drake, MuJoCo and Basilisk fly the same.
    for other in others[1:]:
        differences = [
            float(x)
            for x in re.findall(
                rf"\(b\) - \({other}\): "
                r"+(\d\.\de[-+]\d\d)",
                printed,
            )
        ]
        assert len(differences) == 4
        assert 0.0 < max(differences) < 1e-7


def test_startup(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    startup = importlib.import_module("startup")
    # the others take too long for a test
    monkeypatch.setattr(startup, "PROGRAMS", {"nothing": ["-c", "pass"]})
    startup.main(["--repeats", "1", "--against", str(BENCHMARKS)])
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 2
    # Drake takes longer
    assert float(re.search(r"(\d\.\d\d) \(\d\.\d\d\) of it", printed[1])[1]) < 0.7
    assert printed[1].endswith("of what it takes with --against")
