"""What is said of a scenario before it runs, and what is not loaded for a run."""

import sys
import warnings

import pytest
from children import finished

import ffsm_drake
from ffsm_drake import load_scenario
from ffsm_drake.plugins.design.remarks import plan_remarks
from ffsm_drake.runs.simulate import LimitWarning, StabilityWarning

SHORT = ["duration=0.105", "sensing.delay=1"]  # no whole number of samples, and unstable


def loaded_after(code):
    """The modules that a new process has loaded after running some code."""
    code += "\nimport sys; print(*sorted(sys.modules), sep='\\n')"
    return set(finished([sys.executable, "-c", code], check=True).stdout.split())


@pytest.mark.parametrize(
    "verb", [ffsm_drake.simulate, lambda scenario: ffsm_drake.compare(scenario, ["tdc"])]
)
def test_a_run_says_first_what_is_expected_of_it(verb):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        verb(load_scenario("postcapture", SHORT))
    kinds = [warning.category for warning in caught]
    assert kinds.count(StabilityWarning) == 1
    assert kinds.count(LimitWarning) == 1


@pytest.mark.smoke
def test_it_need_not():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ffsm_drake.simulate(load_scenario("postcapture", SHORT), check_stability=False)


@pytest.mark.slow
def test_a_rollout_loads_nothing_of_the_design():
    run = (
        "from ffsm_drake import Rollout, load_scenario; Rollout(load_scenario('postcapture', "
        "['duration=0.1'])).run()"
    )
    loaded = loaded_after(run)
    assert "ffsm_drake.runs.rollout" in loaded
    assert not [name for name in loaded if name.startswith("ffsm_drake.plugins.design")]


# What takes longer to load than a run to compute, and no run needs.
HEAVY = (
    "dask",
    "jinja2",
    "matplotlib",
    "netCDF4",
    "pandas",
    "plotly",
    "scipy.interpolate",
    "scipy.stats",
    "xarray",
)


@pytest.mark.parametrize(
    ("scenario", "without"),
    [
        ("postcapture", ("scipy",)),
        pytest.param("planar_detumble", ("scipy",), marks=pytest.mark.long),
        # its filter's gain takes scipy.linalg
        ("flight_sensors", ("scipy.optimize", "scipy.integrate")),
        pytest.param(
            "flexible_panels", ("scipy.optimize", "scipy.integrate"), marks=pytest.mark.long
        ),
        pytest.param("free_floating", (), marks=pytest.mark.long),
    ],
)
def test_a_first_run_loads_only_what_it_needs(scenario, without):
    run = (
        "import ffsm_drake as f; "
        f"f.simulate(f.load_scenario('{scenario}', ['duration=0.5'])).metrics"
    )
    loaded = loaded_after(run)
    assert "ffsm_drake.runs.metrics" in loaded
    assert loaded.isdisjoint((*HEAVY, *without))


@pytest.mark.smoke
def test_the_command_line_shows_its_help_without_drake():
    code = "import runpy, sys; sys.argv = ['ffsm', '--help']"
    loaded = loaded_after(
        f"{code}\ntry: runpy.run_module('ffsm_drake', run_name='__main__')\nexcept SystemExit: pass"
    )
    assert "click" in loaded
    assert loaded.isdisjoint((*HEAVY, "numpy", "pydrake", "scipy"))


OTHER = "package://ffsm_drake/urdf/two_arms_target.urdf"


@pytest.mark.parametrize(
    ("more", "is_told"),
    [
        ([], True),
        (["payload.nominal.mass=60"], True),
        (["payload.truth.mass=60"], False),
        ([f"model.debris={OTHER}", "model.grasp=debris::left_grasp"], False),
    ],
)
def test_a_servicer_that_holds_the_shipped_target_unasked_is_told(more, is_told):
    servicer = "model={directives: null, servicer: 'package://ffsm_drake/urdf/servicer.urdf'}"
    told = plan_remarks(load_scenario("postcapture", [servicer, *more]))
    assert any(line.startswith("model.debris: not given") for line in told) == is_told
    assert not any("model.debris" in line for line in plan_remarks(load_scenario("postcapture")))
