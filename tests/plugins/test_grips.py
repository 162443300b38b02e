"""What holds the target in a phase: no part of the scenario, so kept results need it."""

import ast
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

import ffsm_drake
from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.common.memo import content_of
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.compiled.case import case_of
from ffsm_drake.plugins.estimators import coupled
from ffsm_drake.plugins.estimators.filter_gains import SensedAxis
from ffsm_drake.plugins.planning import tvlqr
from ffsm_drake.scenario import EMPTY, HELD, checked
from ffsm_drake.systems.controllers import make_law
from ffsm_drake.systems.reference import make_motion


def _drawn(seed):
    generator = np.random.default_rng(seed)
    duration, mass = generator.uniform([2.0, 20.0], [4.0, 200.0])
    return load_scenario(
        "tumbling_capture",
        [
            f"payload.nominal.mass={mass:.3f}",
            f"reference.duration={duration:.1f}",
            "sample_time=0.1",
            "capture.approach.duration=2",
            "simulator_config.max_step_size=0.1",
        ],
    )


def _gains_of(scenario, grip):
    scenario = dataclasses.replace(scenario, controller="tvlqr")
    return tvlqr._gains_of(make_mission(scenario), grip, {})[:3]


def _gains_along(scenario, grip):
    axes, sensed = np.array([0, 1, 2, 6, 7, 8, 9, 10]), (SensedAxis(1e-3, 1e-3, 1e-3),) * 8
    return coupled._gains_along(make_mission(scenario), grip, axes=axes, sensed=sensed)[1].gains[:1]


def _case_of(scenario, grip):
    return case_of(make_mission(scenario), grip).nominal.calc_mass_matrix(np.eye(12)[0])


def _memoised():
    """Every memoised function of a scenario by its name."""
    for path in Path(ffsm_drake.__file__).parent.rglob("*.py"):
        text = path.read_text()
        if "memoized(" not in text and "functools.lru_cache" not in text:
            continue
        for each in ast.walk(ast.parse(text)):
            if isinstance(each, ast.FunctionDef) and any(
                ast.unparse(mark).startswith(("memoized", "functools.lru_cache"))
                for mark in each.decorator_list
            ):
                kinds = [ast.unparse(one.annotation) for one in each.args.args if one.annotation]
                if {"Scenario", "BlockSetup"} & set(kinds):
                    yield each.name


def test_results_of_a_scenario_are_kept_by_its_mission():
    assert not set(_memoised())


def test_plans_are_kept_until_the_scenario_changes():
    scenario = load_scenario("postcapture")
    motion = make_motion(make_mission(scenario))
    assert make_motion(make_mission(checked(scenario))) is motion
    scenario.reference.duration = 3.0
    assert make_motion(make_mission(scenario)).end == 3.0


@pytest.mark.parametrize("of", [_gains_of, _gains_along, _case_of], ids=lambda each: each.__name__)
def test_a_cache_distinguishes_grips(of):
    scenario = _drawn(0)
    held, empty, again = (content_of(of(scenario, grip)) for grip in (HELD, EMPTY, HELD))
    assert held == again != empty


@pytest.mark.parametrize("seed", range(3))
def test_a_law_knows_the_payload_of_its_phase(seed):
    """A law with a model, made for one grip after another."""
    scenario = dataclasses.replace(_drawn(seed), controller="computed_torque")
    masses = {
        grip: make_law(
            make_mission(scenario), make_nominal_plant(scenario, grip)
        ).model.calc_mass_matrix(np.eye(12)[0])[3, 3]
        for grip in (HELD, EMPTY)
    }
    lost = masses[HELD] - masses[EMPTY]
    assert math.isclose(lost, scenario.payload.nominal.mass, rel_tol=1e-12)
