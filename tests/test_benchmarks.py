"""The benchmark runs, and what it compares is the same motion."""

import dataclasses
import importlib
import importlib.util
import re
import time
from pathlib import Path

import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
ON_BASILISK = importlib.util.find_spec("Basilisk") is not None


WALL_CLOCKS = re.compile(
    r"\b(perf_counter|monotonic|default_timer|clock_gettime|wall_time)"
    r"|\btime\.time\b|from time import|datetime|timeit"
)


@pytest.mark.parametrize("path", sorted(BENCHMARKS.glob("*.py")), ids=lambda path: path.stem)
def test_benchmarks_use_processor_time_and_say_so(path):
    text = path.read_text()
    assert not WALL_CLOCKS.search(text)
    if re.search("process_time|getrusage|processor_time", text):
        assert "rocessor time" in text.replace("\n", " ")
    # the page of their figures
    assert "processor time" in (BENCHMARKS.parent / "docs" / "speed.md").read_text()


class Waiting(LeafSystem):
    """Sleeps in one update and computes in another."""

    def __init__(self):
        super().__init__()
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(1.0, 0.0, self.wait)

    def wait(self, context, values):
        time.sleep(0.02)
        begin = time.process_time()
        while time.process_time() - begin < 0.005:
            pass


def test_time_of_a_run_is_processor_time_within_advance_to(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    rollout = importlib.import_module("rollout")
    builder = DiagramBuilder()
    builder.AddSystem(Waiting())
    simulator, advance = Simulator(builder.Build()), Simulator.AdvanceTo

    def run():
        Waiting.wait(None, None, None)  # outside
        for end in (1.5, 3.5):
            simulator.AdvanceTo(end)

    assert 0.02 <= rollout.advance_time(run) < 0.06  # four updates of 5 ms, and 80 ms asleep
    assert Simulator.AdvanceTo is advance


@pytest.mark.long
def test_rollout(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    rollout = importlib.import_module("rollout")
    rollout.main(["--repeats", "1", "--duration", "0.2"])
    printed = capsys.readouterr().out
    assert printed.startswith("postcapture, tde_aismc, 0.2 s")
    ratio = r"\d+\.\d\d \(\d+\.\d\d\)"
    others = ["a", "c", *(["d"] if ON_BASILISK else [])]
    # several runs at once are runs
    differences = dict(
        re.findall(r"of all runs, largest difference \(b\) - \((.)\): (\S+)", printed)
    )
    assert 0.0 < float(differences["e"]) < 1e-7
    numbers = re.findall(r"\(e\) (\d+) at once", printed)
    assert numbers == ["1", "16", "64"]
    assert len(re.findall(rf"e/a {ratio}", printed)) == len(numbers)
    compiled = "(k) skipped" not in printed
    assert len(re.findall(rf"k/e {ratio}", printed)) == len(numbers) * compiled
    assert not compiled or float(differences["k"]) < 1e-10
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


@pytest.mark.long
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


@pytest.mark.long
def test_campaign_cases(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    cases = importlib.import_module("campaign_cases")
    short = ["--repeats", "1", "--cases", "2", "--duration", "0.1", "--engine", "drake"]
    cases.main(["payload_uncertainty", "flight_sensors", *short])
    printed = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in printed] == [
        *(f"payload_uncertainty, {law}" for law in ("tdc", "asmc", "aismc", "tde_aismc")),
        "payload_uncertainty, mean of its laws",
        "flight_sensors, tde_aismc",
    ]
    pattern = r": (\S+) ms alone, (\S+) ms in a batch: (\S+)$"
    for alone, batched, ratio in (
        map(float, re.search(pattern, line).groups()) for line in printed
    ):
        assert abs(batched / alone - ratio) < 0.01


def test_cases_with_another_engine_are_compared(monkeypatch, capsys):
    pytest.importorskip("llvmlite")
    pytest.importorskip("ffsm_drake.plugins.compiled")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    cases = importlib.import_module("campaign_cases")
    short = ["--cases", "3", "--duration", "0.1", "--engine", "compiled", "--compare"]
    cases.main(["postcapture", *short])
    said = r"postcapture, \w+: 3 (\w+); 0 outcomes or first limits differ; numbers by (\S+) at most"
    found = re.match(said, capsys.readouterr().out)
    assert found[1] in ("settled", "not_settled")
    assert 0.0 < float(found[2]) < 1e-9


@pytest.mark.slow
def test_a_random_mission_that_is_cut_keeps_its_row(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    words = ["baselines.py", "--missions", "1", "-c", "tdc", "--seconds", "0.05"]
    monkeypatch.setattr("sys.argv", words)
    importlib.import_module("baselines").main()
    first, *rest = capsys.readouterr().out.splitlines()
    assert re.search("0 +tdc +cannot say +interrupted +0.00 s +took longer than 0.05 s", first)
    assert "cut by the time limit (--seconds): 1" in rest


@pytest.mark.long
def test_fault_detection(monkeypatch, capsys, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    study = importlib.import_module("fault_detection")
    # the others take too long for a test
    monkeypatch.setattr(study, "ASKED", study.ASKED[:1])
    short = ["--healthy", "2", "--faulty", "2", "--log", str(tmp_path / "log")]
    study.main(short)
    first = capsys.readouterr().out
    assert "2 runs without a fault: 0 with an alarm, 0 given up on it" in first
    assert len((tmp_path / "log").read_text().splitlines()) == 4
    monkeypatch.setattr(study, "fly", None)  # what is known is not run again
    study.main(short)
    assert capsys.readouterr().out.endswith(first[first.index("2 runs without") :])


@pytest.mark.long
def test_a_healthy_run_has_a_twin_and_a_jam_has_none(monkeypatch, capsys, tmp_path):
    """A recorded run of each, in a mission in which detection names the joint."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    records = importlib.import_module("fault_records")
    twins = importlib.import_module("healthy_twins")
    name, jammed = records.jam(0)
    faults = dataclasses.replace(jammed.faults, events={})
    healthy = dataclasses.replace(jammed, faults=faults)
    for kind, scenario in (("jam", jammed), ("healthy", healthy)):
        records.write(tmp_path / f"{kind}.npz", records.fed(f"{kind} {name}", scenario))
    records.main(["decide", str(tmp_path)])
    decided = capsys.readouterr().out
    assert "| healthy | quiet | 1 |" in decided
    assert re.search(r"\| joint_\d | right \| 1 \|", decided)
    twins.main([str(tmp_path / "healthy.npz"), str(tmp_path / "jam.npz")])
    first, second = capsys.readouterr().out.splitlines()
    assert first.endswith(": a healthy twin")
    assert second.endswith(": no healthy twin")
