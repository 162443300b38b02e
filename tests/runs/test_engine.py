"""The choice of the engine without any that is installed: names, and records written before."""

import json

import pytest
from record_tools import sealed

from ffsm_drake import FfsmError, RunRecord, load_scenario, simulate, simulate_many
from ffsm_drake.runs.engine import DRAKE, Engine, NotCovered, find_engine


def test_drake_needs_no_engine_and_unknown_names_list_the_known():
    assert find_engine(DRAKE) is None
    with pytest.raises(FfsmError, match=r"engine: 'drke' is unknown; choose one of drake.*'drake'"):
        find_engine("drke")
    with pytest.raises(FfsmError, match="'x' is unknown"):
        simulate_many([load_scenario("postcapture")], engine="x")


@pytest.mark.parametrize(("name", "told"), [("dynamics", "generated"), ("engine", "compiled")])
def test_a_record_names_its_engine_also_one_written_before(tmp_path, name, told):
    record = simulate(load_scenario("postcapture", ["duration=0.02"]), check_stability=False)
    record.save(tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert "engine" not in manifest
    assert RunRecord.load(tmp_path).engine == DRAKE
    (tmp_path / "manifest.json").write_text(json.dumps(manifest | {name: told}))
    sealed(tmp_path)
    loaded = RunRecord.load(tmp_path)
    assert loaded.engine == told
    loaded.save(tmp_path / "again")
    assert json.loads((tmp_path / "again" / "manifest.json").read_text())["engine"] == told


class Partial(Engine):
    """An engine that covers, and computes, some seeds."""

    def run_all(self, missions, signals=None):
        given = [mission.scenario.random_seed for mission in missions]
        return [None if seed == 1 else NotCovered("odd seeds") for seed in given]


def test_drake_computes_the_rest_and_says_why(monkeypatch):
    monkeypatch.setattr("ffsm_drake.runs.batches.find_engine", lambda name: Partial())
    given = [["duration=0.02", f"random_seed={k}"] for k in (1, 2)]
    scenarios = [load_scenario("postcapture", each) for each in given]
    found = simulate_many(scenarios, engine="partial")
    said = "the run fails or diverges", "not covered: odd seeds"
    assert [record.engine for record in found] == [f"drake ({reason})" for reason in said]
    for record, other in zip(found, simulate_many(scenarios), strict=True):
        assert record.dataset.identical(other.dataset)
