"""A limit: the share of it that values use, and what is said where they exceed it."""

import numpy as np
import pytest

from ffsm_drake import load_scenario
from ffsm_drake.mission import Mission
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, Limit, tightest
from ffsm_drake.systems.mission_limits import limits_of

ONE = Coordinates(joints=("a",), joint_units=("m",))


def limit(quantity, lower, upper):
    base = np.full(6, np.inf)
    bounds = np.r_[base, upper], np.r_[-base, lower]
    return Limit.of_coordinates(quantity, "somebody's limits", ONE, *bounds)


def values(*of_joint):
    return np.column_stack([np.zeros((len(of_joint), 6)), of_joint])


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("lower", "upper", "value", "used"),
    [
        (-2.0, 2.0, -1.0, 0.5),
        (-2.0, 2.0, 3.0, 1.5),
        (1.0, 3.0, 2.0, 0.0),
        (1.0, 3.0, 3.0, 1.0),
        (-np.inf, 3.0, 3.5, 1.5),
        (-np.inf, np.inf, 1e9, -np.inf),
        (-2.0, 2.0, np.nan, -np.inf),
    ],
)
def test_the_used_share(lower, upper, value, used):
    assert limit(RATE, lower, upper).used(values(value))[0, 6] == pytest.approx(used)


@pytest.mark.parametrize("seed", range(20))
def test_a_value_beyond_a_limit_is_told_as_another_number(seed):
    random = np.random.default_rng(seed)
    bound = float(f"{10.0 ** random.uniform(-3, 3):.4g}")
    value = bound * (1.0 + 10.0 ** random.uniform(-8.5, 0.0))
    for quantity, lower in ((RATE, -bound), (POSITION, -0.5 * bound), (POSITION, -bound)):
        given = limit(quantity, lower, bound)
        for sign in (1.0, -1.0) if lower == -bound else (1.0,):
            (line,) = given.remark(values(sign * value), "it", lambda sample: "")
            told, after = line.split(" a ")[1].split(" (limit")
            assert abs(float(told.split()[0])) > bound, line
            assert f"{bound:.4g}" in after


def test_a_remark_names_the_worst_sample():
    def said(*args):
        rows = values(0.5, -3.0, 2.5)
        return list(limit(*args).remark(rows, "it", lambda sample: f" at {sample}"))

    assert said(RATE, -2.0, 2.0) == ["it exceeds somebody's limits: a 3 m/s at 1 (limit 2)"]
    assert said(FORCE, -2.0, 2.0) == ["it exceeds somebody's limits: a 3 N at 1 (limit 2)"]
    assert said(POSITION, -3.0, 2.0) == [
        "it exceeds somebody's limits: a 2.5 at 2 (limits -3 to 2 m)"
    ]
    assert said(RATE, -4.0, 4.0) == []


def test_the_tightest_of_several():
    both = tightest([limit(RATE, -3.0, 2.0), limit(FORCE, -1.0, 1.0), limit(RATE, -1.0, 4.0)], RATE)
    assert (both.lower[6], both.upper[6]) == (-1.0, 2.0)


def test_limits_come_from_the_scenario_and_its_actuators():
    drives = "actuation={limit: {all: 20}, drives: {rate_limit: {joint_2: 0.02}}}"
    scenario = load_scenario("postcapture", [drives])
    limits = limits_of(Mission(scenario))
    rate = tightest(limits, RATE)
    assert rate.upper[rate.names.index("joint_2")] == 0.02
    assert rate.upper[rate.names.index("joint_1")] > 0.02
    assert (tightest(limits, FORCE).upper == 20.0).all()
