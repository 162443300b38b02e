"""Campaigns over thrusters: layouts and failures are values as any other, and what they take is a
column.
"""

import json

import pytest
from campaign_tools import forked, run_here, sql, write_spec

from ffsm_drake import load_scenario, simulate

THRUSTERS = [
    {"layout": "12x5N", "failures": {"a_y": "stuck_off"}},
    {"layout": "16x22N", "failures": {"bottom_2_y": "stuck_on"}},
    {"layout": "12x5N", "failures": {"a_x": "stuck_off", "b_x": "stuck_off"}},
]
CHANGES = {
    "scenario": "thrusters_and_wheels",
    "overrides": {"duration": 0.4},
    "controllers": ["tdc"],
    "cases": len(THRUSTERS),
    "parameters": {
        "actuation.thrusters": {"distribution": "list", "values": THRUSTERS},
        "disturbance.amplitude_scale": {"distribution": "uniform", "low": 0.5, "high": 2.0},
    },
    "factors": {},
    "derive": {},
    "settled": {"hold": 0.1},
}
USED = (
    "propellant", "thruster_impulse", "thruster_pulses", "thrusters_saturated",
    "wheel_speed_used", "wheel_torque_used", "wheels_torque_limited", "wheels_unloading",
)  # fmt: skip
SELECT = (
    f"SELECT case_index, random_seed, outcome, message, itae, {', '.join(USED)}, "
    '"disturbance.amplitude_scale", "actuation.thrusters" FROM runs ORDER BY 1'
)


@pytest.mark.long
def test_layouts_and_failures(tmp_path):
    spec = write_spec(tmp_path / "spec.yaml", **CHANGES)
    one, two = (
        sql(run_here(spec, tmp_path / f"{n}.sqlite", workers=forked(n, in_flight=n)), SELECT)
        for n in (1, 2)
    )
    assert two == one
    assert [json.loads(row[-1]) for row in one] == THRUSTERS
    *run, refused = one
    assert refused[2] == "error"
    assert (
        "with a_x stuck_off, b_x stuck_off no thrusters give a force along [-1, 0, 0]" in refused[3]
    )
    assert len({row[4] for row in run}) == len(run)
    _, seed, _, _, itae, *used, scale, thrusters = run[1]
    overrides = ["duration=0.4", f"random_seed={seed}", f"disturbance.amplitude_scale={scale}"]
    record = simulate(
        load_scenario("thrusters_and_wheels", [*overrides, f"actuation.thrusters={thrusters}"]),
        check_stability=False,
    )
    assert itae == record.metrics["itae"]
    fired, turned = record.metrics["thrusters"], record.metrics["wheels"]
    sums = [sum(fired[name].values()) for name in ("impulse", "pulses")]
    shares = [turned[name] for name in ("speed_used", "torque_used", "torque_limited", "unloading")]
    assert used == pytest.approx([fired["propellant"], *sums, fired["saturated"], *shares])
    assert min(sums) > 0.0
    assert min(shares[:2]) > 0.0
