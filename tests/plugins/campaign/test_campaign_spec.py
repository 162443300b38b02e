"""A campaign's specification: what it means, and how each mistake is told."""

import datetime
import math
import os
import statistics
import sys

import numpy as np
import pytest
import yaml
from campaign_tools import SMALL, invoke, write_spec
from children import finished
from scipy.stats import kstest

from ffsm_drake import Scenario, load_scenario
from ffsm_drake.common.errors import CampaignError
from ffsm_drake.plugins.campaign.cases import make_cases, scenario_of
from ffsm_drake.plugins.campaign.dispersion import (
    case_seed,
    get_value,
    parse_distribution,
    parse_rule,
    set_value,
    unit_points,
)
from ffsm_drake.plugins.campaign.spec import (
    Settled,
    load_spec,
    shipped_campaigns,
    spec_from_json,
)
from ffsm_drake.runs.tracking import Tracked
from ffsm_drake.systems.controllers import PAPER_LAWS


def changed(section, **entries):
    return {section: {**SMALL.get(section, {}), **entries}}


BAD = {
    "unknown key": ({"contrllers": ["tdc"]}, "contrllers: unknown key"),
    "unknown scenario": ({"scenario": "nowhere"}, "nowhere"),
    "unknown controller": ({"controllers": ["pid"]}, "'pid' is unknown"),
    "controller twice": ({"controllers": ["tdc", "tdc"]}, "each once"),
    "no cases": ({"cases": 0}, "cases: must be from 1 to 1000000, not 0"),
    "no parameters": ({"parameters": {}, "factors": {}, "derive": {}}, "at least one"),
    "unknown distribution": (
        changed("parameters", sample_time={"distribution": "gamma", "low": 1, "high": 2}),
        "distribution 'gamma' is unknown",
    ),
    "low above high": (
        changed("parameters", sample_time={"distribution": "uniform", "low": 2, "high": 1}),
        "parameters.sample_time: low must be below high",
    ),
    "log of zero": (
        changed("parameters", sample_time={"distribution": "log_uniform", "low": 0, "high": 1}),
        "low: must be > 0",
    ),
    "no spread": (
        changed("parameters", sample_time={"distribution": "normal", "mean": 1, "deviation": 0}),
        "deviation: must be > 0",
    ),
    "missing bound": (
        changed("parameters", sample_time={"distribution": "uniform", "low": 0}),
        "needs high",
    ),
    "unknown scenario key": (
        changed(
            "parameters", **{"payload.truth.mas": {"distribution": "uniform", "low": 1, "high": 2}}
        ),
        "payload.truth.mas: unknown key",
    ),
    "unknown coordinate": (
        changed(
            "parameters",
            **{"initial_velocity.joint_9": {"distribution": "uniform", "low": 0, "high": 1}},
        ),
        "joint_9: unknown coordinate",
    ),
    "past the list": (
        changed(
            "parameters",
            **{"payload.truth.center_of_mass.3": {"distribution": "uniform", "low": 0, "high": 1}},
        ),
        "must be a number from 0 to 2",
    ),
    "reserved": (
        changed("parameters", random_seed={"distribution": "choice", "values": [1, 2]}),
        "follows from 'seed'",
    ),
    "set twice": (
        changed("derive", **{"payload.truth.mass": {"rule": "scale", "of": "nominal_error"}}),
        "set once",
    ),
    "one within another": (
        changed("parameters", **{"payload.truth": {"distribution": "choice", "values": [1]}}),
        "lies within payload.truth",
    ),
    "idle factor": (
        changed("factors", idle={"distribution": "uniform", "low": 0, "high": 1}),
        "no rule of 'derive' uses it",
    ),
    "factor named as a key": (
        changed("factors", sample_time={"distribution": "uniform", "low": 0, "high": 1}),
        "must be a free name",
    ),
    "several directions": (
        changed(
            "derive",
            duration={"rule": "direction", "of": ["a", "b"], "height": "h", "azimuth": "a"},
        ),
        "duration.of: must be text, not ['a', 'b']",
    ),
    "resting at nothing": (changed("settled", rest=0), "settled.rest: must be > 0, not 0"),
    "unknown rule": (
        changed("derive", duration={"rule": "exec", "of": "nominal_error"}),
        "rule 'exec' is unknown",
    ),
    "unknown source": (
        changed("derive", duration={"rule": "scale", "of": "nothing"}),
        "'nothing' is neither",
    ),
    "list as a number": (
        changed(
            "derive",
            duration={"rule": "relative", "of": "sample_time", "error": "payload.truth.inertia"},
        ),
        "needs a single number, not a list",
    ),
    "unknown group": ({"settled": {"tolerance": {"arm": 1}}}, "settled.tolerance.arm: 'arm' is"),
    "bad tolerance": ({"settled": {"tolerance": {"joints": 0}}}, "joints: must be > 0"),
    "impossible value": (
        {"parameters": {"payload.truth.mass": {"distribution": "uniform", "low": -9, "high": -8}}},
        "payload.truth.mass: must be > 0 kg",
    ),
    "400 digits": (
        {"cases": 10**400},
        "cases: must be from 1 to 1000000, not a number",
    ),
    "beyond 64 bits in a list": (
        changed(
            "parameters",
            **{"blocks.sensing.settings.k": {"distribution": "choice", "values": [1, 2**63]}},
        ),
        "values.9223372036854775808: a whole number must fit into 64 bits",
    ),
    "too many numbers": (
        {
            "cases": 1_000_000,
            "factors": {
                f"f{k}": {"distribution": "uniform", "low": 0, "high": 1} for k in range(30)
            },
            "derive": {
                "payload.nominal.mass": {"rule": "scale", "of": [f"f{k}" for k in range(30)]}
            },
        },
        "more than 20000000 numbers",
    ),
    "a product beyond numbers": (
        {
            "parameters": {"duration": {"distribution": "choice", "values": [1e20]}},
            "factors": {},
            "derive": {"sample_time": {"rule": "scale", "of": ["duration"] * 16}},
        },
        "sample_time: is not finite in case 0: inf",
    ),
    "no sources": (changed("derive", duration={"rule": "sum", "of": []}), "sum needs of"),
    "a column of the results": (
        {
            "factors": {"Outcome": {"distribution": "uniform", "low": 0, "high": 1}},
            "derive": {
                "payload.nominal.mass": {"rule": "scale", "of": ["Outcome", "payload.truth.mass"]}
            },
        },
        "factors.Outcome: is the name of a column of the results",
    ),
    "columns that differ by case": (
        {
            "factors": {
                name: {"distribution": "uniform", "low": 0, "high": 1}
                for name in ("ratio", "Ratio")
            },
            "derive": {"payload.nominal.mass": {"rule": "scale", "of": ["ratio", "Ratio"]}},
        },
        "factors.Ratio: is the name of a column already, 'ratio'",
    ),
    "a name that is no text": (
        changed("parameters", **{"a\0b": {"distribution": "choice"}}),
        "must be text that a file can hold",
    ),
    "a name of two lines": (
        changed("parameters", **{"a\nb": {"distribution": "choice", "values": [1]}}),
        "parameters: the name 'a\\nb' must be printable text",
    ),
    "a date": (
        {"scenario": datetime.date(2024, 1, 1)},
        "2024-01-01",  # text, as all that YAML's core schema does not name
    ),
    "no prediction": ({"predictions": "no"}, "predictions: must be true or false, not 'no'"),
    "no time": ({"time_limit": 0}, "time_limit: must be > 0, at most 1000000 s, not 0"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_specification_is_one_line(name, tmp_path):
    changes, said = BAD[name]
    spec = write_spec(tmp_path / "bad.yaml", **changes)
    result = invoke("run", spec, "--database", tmp_path / "x.db")
    assert result.exit_code == 2, result.output
    assert said in result.output
    assert result.output.count("\n") == 1
    assert len(result.output) < 2000
    assert not (tmp_path / "x.db").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1, 2]", "must be a mapping"),
        ("a: [", "is not valid YAML"),
        ("a: &a [*a]", "contains itself"),
        ("cases: 1\ncases: 2", "given twice"),
        ("cases: " + 5000 * "9", "is not valid YAML"),
        ("[" * 2000, "nested deeper"),
        ("a: 2024-13-45", "a: unknown key; valid here: "),
        ('description: "\\ud800"', "must be text that a file can hold"),
        (None, "no such campaign; choose one of flexible_panels"),
    ],
)
def test_a_file_that_is_no_specification(text, said, tmp_path):
    """Without a text: a file without end, which is not opened."""
    path = tmp_path / "bad.yaml"
    os.mkfifo(path) if text is None else path.write_text(text)
    result = invoke("plan", path)
    assert result.exit_code == 2
    assert said in result.output
    assert result.output.count("\n") == 1


@pytest.mark.parametrize("sampling", ["latin_hypercube", "sobol", "random"])
def test_points_are_uniform_and_repeatable(sampling):
    points = unit_points(sampling, cases=512, dimensions=3, seed=7)
    assert (points == unit_points(sampling, cases=512, dimensions=3, seed=7)).all()
    assert (points != unit_points(sampling, cases=512, dimensions=3, seed=8)).any()
    assert 0.0 < points.min() < points.max() < 1.0
    for column in points.T:
        assert kstest(column, "uniform").pvalue > 1e-3
    if sampling == "latin_hypercube":
        assert all(len({int(512 * x) for x in column}) == 512 for column in points.T)


@pytest.mark.smoke
def test_distributions_have_their_quantiles():
    make = lambda **data: parse_distribution(data, place="x")  # noqa: E731
    uniform = make(distribution="uniform", low=2, high=6)
    assert [uniform.value(u, 0) for u in (0.25, 0.5)] == [3.0, 4.0]
    log = make(distribution="log_uniform", low="1e-7", high=1e-5)
    assert log.value(0.5, 0) == pytest.approx(1e-6)
    assert 1e-7 <= log.value(1e-12, 0) <= log.value(1 - 1e-12, 0) <= 1e-5
    normal = make(distribution="normal", mean=5, deviation=2)
    assert normal.value(0.5, 0) == 5.0
    assert normal.value(0.975, 0) == pytest.approx(5 + 2 * 1.959964, rel=1e-6)
    choice = make(distribution="choice", values=["one_sample", "kalman", [1, 2]])
    assert [choice.value(u, 0) for u in (0.1, 0.5, 0.999999)] == ["one_sample", "kalman", [1, 2]]
    listed = make(distribution="list", values=[3, 1])
    assert [listed.value(0.5, case) for case in range(3)] == [3, 1, 3]


@pytest.mark.smoke
def test_rules():
    apply = lambda values, **data: parse_rule(data, place="x").apply(values)  # noqa: E731
    assert apply([100.0], rule="solid_cube", mass="m", side=1.0) == pytest.approx([100 / 6] * 3)
    assert apply([10.0], rule="solid_sphere", mass="m", radius=2.0) == pytest.approx([16.0] * 3)
    assert apply([100.0, -0.2], rule="relative", of="m", error="f") == pytest.approx(80.0)
    assert apply([[1.0, 2.0], 0.5], rule="relative", of="i", error="f") == [1.5, 3.0]
    assert apply([3.0, 2.0], rule="scale", of=["a", "b"], by=[1, 0, 2]) == [6.0, 0.0, 12.0]
    turned = apply([2.0, 0.6, math.pi / 2], rule="direction", of="w", height="h", azimuth="a")
    assert turned == pytest.approx([0.0, 1.6, 1.2])
    with pytest.raises(CampaignError, match=r"height must be from -1 to 1, not 1\.5"):
        apply([2.0, 1.5, 0.0], rule="direction", of="w", height="h", azimuth="a")
    assert apply([1.0, 2.5], rule="sum", of=["a", "b"]) == 3.5
    assert apply([[1.0, 2.0], [3.0, 4.0]], rule="sum", of=["a", "b"]) == [4.0, 6.0]
    with pytest.raises(CampaignError, match="only one"):
        apply([[1.0], [2.0]], rule="scale", of=["a", "b"])
    with pytest.raises(CampaignError, match="same length"):
        apply([[1.0], [2.0, 3.0]], rule="sum", of=["a", "b"])


@pytest.mark.smoke
def test_cases_follow_from_the_specification_alone(tmp_path):
    spec = load_spec(write_spec(tmp_path / "s.yaml"))
    cases = list(make_cases(spec))
    assert cases == list(make_cases(spec_from_json(spec.to_json())))
    assert len({case.seed for case in cases}) == len(cases)
    for case in cases:
        assert case.seed == case_seed(spec.seed, case.index)
        mass, error = case.values["payload.truth.mass"], case.values["nominal_error"]
        tdc, asmc = (scenario_of(spec, case, name) for name in ("tdc", "asmc"))
        assert tdc.payload.nominal.mass == pytest.approx(mass * (1 + error))
        assert tdc.payload.nominal.inertia == pytest.approx([mass / 6 * (1 + error)] * 3)
        # Paired: all but the controller is the same.
        assert tdc.random_seed == asmc.random_seed == case.seed
        assert (tdc.payload, tdc.sensing) == (asmc.payload, asmc.sensing)
    other = load_spec(write_spec(tmp_path / "t.yaml", seed=6))
    assert other.fingerprint != spec.fingerprint
    assert [case.seed for case in make_cases(other)] != [case.seed for case in cases]
    assert (
        load_spec(write_spec(tmp_path / "u.yaml", description="other words")).fingerprint
        == spec.fingerprint
    )


def test_the_shipped_campaign():
    spec = load_spec("payload_uncertainty")
    assert spec.controllers == list(PAPER_LAWS)
    cases = list(make_cases(spec))
    masses = [case.values["payload.truth.mass"] for case in cases]
    ratios = [
        case.values["payload.nominal.mass"] / case.values["payload.truth.mass"] for case in cases
    ]
    noises = [math.log10(case.values["sensing.velocity_noise"]) for case in cases]
    assert 20 <= min(masses) < 21
    assert 299 < max(masses) <= 300
    assert 0.5 <= min(ratios) < 0.501
    assert 1.199 < max(ratios) <= 1.2
    assert -7 <= min(noises) < -6.99
    assert statistics.fmean(noises) == pytest.approx(-6, abs=1e-3)
    assert all(
        yaml.safe_load(path.read_text())["description"] for path in shipped_campaigns().values()
    )


def test_the_shipped_tumble():
    cases = list(make_cases(load_spec("tumble")))
    masses, rates, offsets = (
        np.array([case.values[name] for case in cases])
        for name in ("payload.truth.mass", "capture.rate", "payload.truth.center_of_mass")
    )
    assert 20 <= masses.min() < 22
    assert 298 < masses.max() <= 300
    for vectors, largest in ((rates, math.radians(10.0)), (offsets, 0.1)):
        size = np.linalg.norm(vectors, axis=1)
        assert 0.99 * largest < size.max() <= largest * (1 + 1e-12)
        axes = vectors / size[:, None]
        # Of isotropic directions mean 0 and covariance 1/3, to the scatter of so many cases.
        assert np.abs(axes.mean(axis=0)).max() < 3 * math.sqrt(1 / 3 / len(cases))
        assert axes.T @ axes / len(cases) == pytest.approx(
            np.eye(3) / 3, abs=3 * math.sqrt(4 / 45 / len(cases))
        )


def test_set_value_reaches_lists_and_absent_mappings():
    data = {"a": [1, 2], "b": {"c": None}}
    set_value(data, "a.1", 5)
    set_value(data, "b.c.joint_1", 7)
    assert data == {"a": [1, 5], "b": {"c": {"joint_1": 7}}}
    with pytest.raises(CampaignError, match="within a single value"):
        set_value(data, "a.1.x", 0)


def test_values_of_a_phase_have_its_name_or_its_place():
    data = {"phases": ["wait", {"hold": {"distance": 1}}, "stop"]}
    for key in ("phases.wait.duration", "phases.1.hold.distance", "phases.hold.distance"):
        set_value(data, key, len(key))
        assert get_value(data, key) == len(key)
    assert data["phases"] == [{"wait": {"duration": 20}}, {"hold": {"distance": 20}}, "stop"]
    with pytest.raises(CampaignError, match="'park' must be a number from 0 to 2"):
        set_value(data, "phases.park.duration", 3)


def settled(scenario=None, **given):
    return Settled(**given).completed(scenario or Scenario())


@pytest.mark.smoke
@pytest.mark.parametrize("seed", range(40))
def test_settled_means_until_the_end(seed):
    """Random errors and rates, evaluated sample by sample; a sample without a number is outside."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 10.5, 0.5)
    bound, rest = {"joints": 0.1, "base_position": 1.0}, random.choice([None, 0.05])
    groups = ("base_position", "joints")
    error = random.choice([0.5, 0.999, 1.001], (time.size, 2), p=[0.5, 0.4, 0.1]) * [1.0, 0.1]
    error[random.random(error.shape) < 0.02] = np.nan
    velocity = random.choice([0.04, -0.06], (time.size, 2), p=[0.9, 0.1])
    hold = random.choice([0.0, 2.0])
    error[time > 10.0 - random.integers(0, 5)] = velocity[time > 10.0 - random.integers(0, 8)] = 0.0
    good = [
        all(abs(x) <= bound[group] for group, x in zip(groups, errors, strict=True))
        and (rest is None or max(abs(rates)) <= rest)
        for errors, rates in zip(error, velocity, strict=True)
    ]
    since = [t for k, t in enumerate(time) if all(good[k:]) and t <= 10.0 - hold]
    tracked = Tracked(error=error, names=groups, groups=groups, units=("m", "rad"))
    criterion = settled(hold=hold, tolerance=bound, rest=rest)
    assert criterion.time(time, tracked, velocity=velocity) == (since[0] if since else None)


def test_tolerances_are_those_of_the_scenario():
    own = settled(load_scenario("slow_navigation"), tolerance={"joints": 0.1}).tolerance
    assert own == {"base_rotation": 1e-3, "base_position": 5e-3, "joints": 0.1}


def test_help_needs_no_drake():
    # The package itself may load Drake; what the commands add must not.
    script = (
        "import sys, ffsm_drake; before = set(sys.modules); "
        "import ffsm_drake.plugins.campaign.command; "
        "heavy = {name.partition('.')[0] for name in set(sys.modules) - before}; "
        "print(heavy & {'pydrake', 'numpy', 'scipy', 'xarray', 'plotly', 'distributed', 'jinja2'})"
    )
    assert finished([sys.executable, "-c", script], check=True).stdout == "set()\n"


def test_texts_that_look_like_numbers_stay_texts_in_overrides(tmp_path):
    path = write_spec(tmp_path / "spec.yaml", overrides={"description": "a title"})
    path.write_text(path.read_text().replace("a title", "'1e5'"))
    assert load_spec(path).base["description"] == "1e5"
