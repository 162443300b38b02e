"""Missions that a verdict must get right: how each run ends, and what is said of it before."""

import functools
import re
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from ffsm_drake import load_scenario
from ffsm_drake.runs.exceeded_limits import run_remarks
from ffsm_drake.runs.simulate import make_record, prepare

CASES = yaml.safe_load(Path(__file__).with_name("verdict_cases.yaml").read_text())["cases"]


def _mean_force(record):
    return np.mean(record.dataset["generalized_force"].sel(coordinate="base_position_x").values)


def _joint_error(record):
    error = record.dataset["error"]
    return np.abs(error.values[:, error["group"].values == "joints"]).max()


def _quaternion_error(record):
    norm = np.linalg.norm(record.dataset["position"].values[:, :4], axis=1)
    return np.abs(norm - 1.0).max()


FIGURES = {
    "mean force on base_position_x": _mean_force,
    "angular momentum residual": lambda record: record.metrics["momentum_residual"]["angular"],
    "error of the quaternion's norm": _quaternion_error,
    "largest error of a joint": _joint_error,
}


@pytest.fixture(scope="module")
def verdicts():
    """The benchmark that asks for verdicts and tells how runs end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
        import verdicts

        yield verdicts


@functools.cache
def run(number):
    """The log and the record of a case."""
    scenario = load_scenario(CASES[number]["base"], CASES[number]["overrides"])
    rollout = prepare(scenario, check_stability=False)
    start = time.perf_counter()
    log = rollout.run()
    rollout.release()
    return log, make_record(log, start=start)


FIRST = {case["number"]: k for k, case in reversed(list(enumerate(CASES)))}
LONGEST = {9, 12}  # classes whose runs take longest


def cases(on_each_change):
    return pytest.mark.parametrize(
        "number",
        [
            pytest.param(
                k,
                id=f"{case['number']} {case['name']}".replace(" ", "-"),
                marks=pytest.mark.slow if k in on_each_change else pytest.mark.long,
            )
            for k, case in enumerate(CASES)
        ],
    )


def test_every_class_is_there():
    assert {case["number"] for case in CASES} == set(range(1, 13))


@cases({k for number, k in FIRST.items() if number not in LONGEST})
def test_the_run_ends_as_said(number, verdicts):
    case, (log, record) = CASES[number], run(number)
    end = verdicts.end_of(log)
    assert end.kind in case["end"], end
    if end.kind == "diverged":
        first, last = case["between"]
        assert first <= end.time <= last
    for name, (least, most) in case.get("figures", {}).items():
        assert least <= FIGURES[name](record) <= most, name


@cases([])
def test_a_user_is_told(number, verdicts):
    """Warned where the run ends badly, in words that help; not where it settles."""
    case, (log, record) = CASES[number], run(number)
    warns = case.get("warns", verdicts.end_of(log).kind in verdicts.BAD)
    for when in case.get("told", ["before"]):
        if when == "before":
            predicted = verdicts.predict(log.scenario)
            told = predicted.warnings + (predicted.beside if warns else [])
        else:
            told = [log.ending.sentence, *run_remarks(record)]
        text = "\n".join(told)
        if not warns:
            assert not told, text
            continue
        assert told
        missing = [word for word in case["words"] if not re.search(word, text, re.IGNORECASE)]
        assert not missing, f"{missing} not in: {text}"
