"""Records of capabilities in any combination: what a run writes is read back bit for bit, and
tables and exports are made from what is read.
"""

import json
import os

import numpy as np
import pytest
from covering import is_refused
from missions import FACTORS, PLAIN, REFUSED, overrides_of, spacecraft_of

from ffsm_drake import FfsmError, RunRecord, load_scenario, override_scenario, simulate
from ffsm_drake.plugins.exports.export import EXPORTERS
from ffsm_drake.runs.metrics import momentum_residual
from ffsm_drake.scenario import shipped_scenarios
from ffsm_drake.show.results import results_of
from ffsm_drake.show.tables import results_data, results_table

DRAWS = int(os.environ.get("FFSM_DRAWS", "4"))
FURTHER = {
    "friction": {"simulator_config.max_step_size": 0.001, "actuation.drives": {
        "viscous_friction": 1.0, "coulomb_friction": 0.5, "smoothing_rate": 0.05}},
    "rates": {"actuation": {"drives": {"rate_limit": 0.5}, "limit": {"joints": 200.0}}},
    "orbit": {"environment": {"altitude": 500e3}},
    "plume": {"actuation": {"thrusters": {"layout": "16x22N", "plume": {}}}},
    "filter": {"command_filter": {"low_pass": 20.0, "notch": 5.0}},
    "bias": {"sensing": {"velocity_bias": 1e-5, "velocity_quantization": 1e-6}},
    "supervisor": {"supervisor": {}, "actuation.limit": {"all": 1e3}},
    "faults": {"faults": {"detection": {}}},
    "jam": {"faults.events.stuck": {"unit": "joints.joint_1", "kind": "jammed", "time": [0.1]}},
    "gear": {"model.flexible": {"soft": {"kind": "joint", "joint": "joint_2",
                                         "frequency": 2.0}}},
    "law": {"controller": "tde_aismc"}, "frame": {"reference.frame": {"task": "position"}},
}  # fmt: skip
SHORT = 0.12  # s


def draw(seed, folder):
    """A scenario put together at random; None if that is refused."""
    random = np.random.default_rng(seed)
    pick = random.choice
    try:
        if random.random() < 0.6:
            while True:
                row = {name: str(pick(values)) for name, values in FACTORS.items()}
                motion = str(pick(["polynomial", "shaped", "frame"]))
                row |= {"spacecraft": "shipped", "motion": motion, "command": "run"}
                if not is_refused(row, REFUSED):
                    break
            file = spacecraft_of(row["spacecraft"], folder)
            scenario = load_scenario(file, overrides_of({**PLAIN, **row}, load_scenario(file), ""))
        else:
            row = str(pick([*shipped_scenarios()]))
            scenario = load_scenario(row)
        more = pick([*FURTHER], size=random.integers(4), replace=False)
        for name in more:
            scenario = override_scenario(scenario, [FURTHER[str(name)]])
        quick = {}
        if scenario.capture is not None and scenario.capture.approach is not None:
            quick = {"capture.approach.duration": SHORT}
        scenario = override_scenario(scenario, [{"duration": 2.0 * SHORT, **quick}])
        return (row, *map(str, more)), simulate(scenario, check_stability=False)
    except FfsmError as error:
        if os.environ.get("FFSM_SAY"):
            print(seed, str(error)[:200])
        return None


def check(record, folder):
    record.save(folder)
    found = RunRecord.load(folder)
    assert found.dataset.identical(record.dataset)
    for name in ("scenario", "outcome", "parts", "software", "engine"):
        told = [json.dumps(getattr(each, name), default=repr) for each in (found, record)]
        assert told[0] == told[1] or name == "scenario", name
    given = set(record.dataset.data_vars)
    assert given == {*found.dataset.data_vars}
    assert momentum_residual(found.dataset).keys() == {"linear", "angular"}
    assert results_table([found]) == results_table([record])
    assert repr(results_data([found])) == repr(results_data([record]))
    results_of([found])
    for end in EXPORTERS.offers():
        if end in ("csv", "mat"):
            EXPORTERS.load(end, end)(found, folder / f"run.{end}")
    return given


@pytest.mark.long
def test_every_record_is_read_back(tmp_path):
    pytest.importorskip("ffsm_drake.plugins.new")
    made, signals = 0, set()
    for seed in range(DRAWS):
        drawn = draw(seed, tmp_path / "craft")
        if drawn is None:
            continue
        try:
            signals |= check(drawn[1], tmp_path / str(seed))
        except Exception as error:
            raise AssertionError(f"draw {seed}: {drawn[0]}: {error}") from error
        made += 1
    print(f"{made} of {DRAWS} combinations ran, with {len(signals)} signals")
    assert made >= DRAWS // 4


@pytest.mark.parametrize("name", ["friction_and_panels"])
def test_the_work_of_friction_is_read_by_joint(name, tmp_path):
    scenario = load_scenario("flexible_panels", [FURTHER["friction"], f"duration={SHORT}"])
    signals = check(simulate(scenario, check_stability=False), tmp_path / name)
    assert {"friction_work", "elastic_energy"} <= signals
