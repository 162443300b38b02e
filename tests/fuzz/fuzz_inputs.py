"""Hostile inputs made at random from good ones: one line and an exit status, or a result; never a
traceback or a hang.

Beside the suite: ``pytest tests/fuzz/fuzz_inputs.py [--inputs 5000] [--fuzz-seed 1]``. The same
seed tries the same inputs; a failure prints its input.
"""

import copy
import math
import re
import shutil
import time
import warnings
from pathlib import Path

import pytest
import yaml
from campaign_tools import SMALL, run_here, write_spec
from click.testing import CliRunner
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from outside_urdfs import OUTSIDE, arm_alone, stage

from ffsm_drake import load_scenario
from ffsm_drake.cli import main
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.scenario import shipped_scenarios
from ffsm_drake.spacecraft.plant import models_dir

LONGEST = 30.0  # s of processor time for one input, however busy the machine is
WAIT = 120.0  # s, after which it waits for what never comes
SHARES = {
    "scenario": 0.35,
    "campaign": 0.2,
    "urdf": 0.2,
    "new": 0.1,
    "database": 0.15,
}  # of the inputs

HOSTILE = st.sampled_from(
    [
        None,
        True,
        False,
        0,
        -1,
        1,
        3,
        2**63,
        10**400,
        -0.0,
        0.5,
        1e-320,
        1e-9,
        1e9,
        1e308,
        math.inf,
        -math.inf,
        math.nan,
        "",
        " ",
        "x",
        "0",
        "1e5",
        "01:30",
        "../..",
        "/dev/zero",
        "/",
        "a:b",
        "os:getcwd",
        "null",
        "\u202e",
        "\ud800",
        "\0",
        "x" * 5000,
        [],
        [0, 0, 0],
        [1e308] * 6,
        ["x"],
        [[[]]],
        [math.nan] * 3,
        {},
        {"all": -1},
        {"x": {"y": 1}},
        "tdc",
        "kalman",
        "flight_sensors",
        "package:///etc",
        "file:///etc/passwd",
        "debris",
        "servicer::base",
    ]
).map(copy.deepcopy)


def paths(data, prefix=()):
    """All places in plain data."""
    for key, value in (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    ):
        yield (*prefix, key)
        yield from paths(value, (*prefix, key))


@st.composite
def mutated_data(draw, goods):
    """Plain data with one to three entries replaced, left out or added."""
    data = copy.deepcopy(draw(st.sampled_from(goods)))
    for _ in range(draw(st.integers(1, 3))):
        places = list(paths(data))
        if not places:
            break
        *parents, last = draw(st.sampled_from(places))
        holder = data
        for key in parents:
            holder = holder[key]
        kind = draw(st.sampled_from(["replace", "replace", "replace", "scale", "remove", "add"]))
        if kind == "remove":
            del holder[last]
        elif kind == "add" and isinstance(holder, dict):
            holder[draw(st.sampled_from(["x", "all", "joints", "", "1", 5, "joint_1"]))] = draw(
                HOSTILE
            )
        elif kind == "scale" and type(holder[last]) in (int, float) and abs(holder[last]) < 1e200:
            holder[last] *= draw(st.sampled_from([-1, 0.5, 3, 1e3, 1e-6, 1e12]))
        else:
            holder[last] = draw(HOSTILE)
    return data


@st.composite
def mutated_bytes(draw, good, at_most=6):
    """A file's bytes with some flipped, or a piece cut out or repeated."""
    content = bytearray(good)
    for _ in range(draw(st.integers(1, at_most))):
        at = draw(st.integers(0, max(len(content) - 1, 0)))
        kind = draw(st.sampled_from(["flip", "flip", "flip", "cut", "repeat", "end"]))
        if kind == "flip" and content:
            content[at] ^= draw(st.integers(1, 255))
        elif kind == "cut":
            del content[at : at + draw(st.sampled_from([1, 8, 512]))]
        elif kind == "repeat":
            content[at:at] = content[at : at + draw(st.sampled_from([1, 40, 400]))]
        else:
            del content[max(at, len(content) // 2) :]
    return bytes(content)


NUMBER = re.compile(r'(?<=")[-+0-9.e ]+(?=")')
WORD = re.compile(r'(?<=")[a-z_]+(?=")')


@st.composite
def mutated_urdf(draw, goods):
    """A URDF with some attributes, tags or bytes changed."""
    text = draw(st.sampled_from(goods))
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["number", "number", "word", "line", "tag"]))
        pattern = {
            "number": NUMBER,
            "word": WORD,
            "line": re.compile(r".+\n"),
            "tag": re.compile(r"<[a-z]+"),
        }[kind]
        found = list(pattern.finditer(text))
        if not found:
            continue
        chosen = draw(st.sampled_from(found))
        new = {
            "number": [
                "0",
                "-1",
                "nan",
                "inf",
                "1e308",
                "1e-320",
                "",
                "x",
                "1 2",
                "0 0 0",
                "1e9 0 0",
                "-1 -1 -1",
            ],
            "word": [
                "",
                "world",
                "base",
                "debris",
                "revolute",
                "planar",
                "floating",
                "fixed",
                "joint_1",
                "link_1",
                "x",
                "ball",
                "../../etc/passwd",
                "package://x/y.obj",
            ],
            "line": [
                "",
                2 * chosen[0],
                "<mimic joint='joint_1'/>\n",
                "<limit lower='3' upper='-3' effort='-1'/>\n",
                "<visual><geometry><mesh filename='/dev/zero'/></geometry></visual>\n",
                "<!-- -- -->\n",
            ],
            "tag": ["<link", "<joint", "<x", "<!--", "<collision", "<drake:joint", "<frame"],
        }[kind]
        text = text[: chosen.start()] + draw(st.sampled_from(new)) + text[chosen.end() :]
    return text


@pytest.fixture
def fuzz(request, tmp_path, monkeypatch):
    """fuzz(kind, strategy, check): call the check with so many inputs of a kind."""
    monkeypatch.chdir(tmp_path)

    def run(kind, strategy, check):
        count = max(int(SHARES[kind] * request.config.getoption("--inputs")), 1)
        limits = settings(
            max_examples=count,
            deadline=None,
            database=None,
            suppress_health_check=list(HealthCheck),
            phases=[Phase.generate],
        )
        seed(request.config.getoption("--fuzz-seed"))(limits(given(strategy)(check)))()

    return run


def invoke(*words, good=(0,), keep=False):
    """A command's exit status, which is that of a good result or, with one line, 2; with ``keep``,
    ``out`` stays.
    """
    before, start = {*Path().iterdir()}, time.process_time()
    try:
        with time_limit(WAIT), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = CliRunner().invoke(main, [str(word) for word in words])
    except TimeLimit:
        raise AssertionError(f"{words[0]} did not end") from None
    assert time.process_time() - start < LONGEST, f"{words[0]} takes too long"
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(
        result.exception
    )
    assert "Traceback" not in result.output
    assert result.exit_code in (*good, 2), result.output
    if result.exit_code == 2:
        errors = [
            line
            for line in result.stderr.splitlines()
            if not line.startswith(("warning: ", "Usage: ", "Try "))
        ]
        # progress
        errors = [line for line in errors if line and not re.search(r": +\d+ of [\d.e-]+ s$", line)]
        assert len(errors) == 1, result.stderr
        assert len(errors[0]) < 2000, errors[0]
        assert {*Path().iterdir()} == before, "refused, but something was written"
    assert {*Path().iterdir()} - before <= {Path("out")}, "something was written elsewhere"
    if not keep:
        shutil.rmtree("out", ignore_errors=True)
    return result.exit_code


def write(name, content):
    """A file with any text: half characters are written as they are."""
    Path(name).write_bytes(
        content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
    )
    return name


def test_scenarios(fuzz):
    """What ``validate`` accepts, ``run`` runs."""
    goods = [
        yaml.safe_load(path.read_text()) | {"duration": 0.02}
        for path in shipped_scenarios().values()
    ]
    text = yaml.safe_dump(goods[0]).encode()

    def check(given):
        mutated = given if isinstance(given, bytes) else yaml.safe_dump(given, allow_unicode=True)
        file = write("s.yaml", mutated)
        if invoke("validate", file) == 0:
            with time_limit(WAIT):
                scenario = load_scenario(file)
            if scenario.num_control_periods < 100:
                assert invoke("run", file, "--no-report", "--out", "out", good=(0, 3)) != 2, (
                    "valid, but not run"
                )

    fuzz(
        "scenario", st.one_of(mutated_data(goods), mutated_data(goods), mutated_bytes(text)), check
    )


def test_campaigns(fuzz):
    small = SMALL | {"overrides": {"duration": 0.02}, "cases": 2}
    listed = {"estimator.kind": {"distribution": "list", "values": ["one_sample", "kalman"]}}
    goods = [small, small | {"parameters": listed, "factors": {}, "derive": {}}]

    def check(given):
        write("c.yaml", yaml.safe_dump(given, allow_unicode=True))
        invoke("campaign", "plan", "c.yaml")

    fuzz("campaign", mutated_data(goods), check)


def test_urdfs(fuzz):
    goods = [
        (models_dir() / "urdf" / f"{name}.urdf").read_text()
        for name in ("servicer", "debris", "ssrms_servicer")
    ]

    def check(given):
        write("r.urdf", given)
        role = "debris" if 'name="grasp"' in given else "servicer"
        with_it = [f"model.{role}=r.urdf", "duration=0.02"]
        words = [word for each in with_it for word in ("--set", each)]
        name = "seven_joint" if "ssrms" in given else "postcapture"
        if invoke("validate", name, *words) == 0:
            assert invoke("run", name, *words, "--no-report", "--out", "out", good=(0, 3)) != 2, (
                "valid, but not run"
            )

    fuzz("urdf", mutated_urdf(goods), check)


def test_new(fuzz):
    """What ``new`` writes is valid."""
    servicers = [
        (models_dir() / "urdf" / f"{name}.urdf").read_text()
        for name in ("servicer", "ssrms_servicer")
    ]
    servicers += [make() for make in OUTSIDE.values()]
    targets = [(models_dir() / "urdf" / "debris.urdf").read_text(), stage()]
    on_a_bus = ["--bus-mass", 400]
    options = st.sampled_from(
        [[], [], on_a_bus, ["--target", 30], ["--tip", "link_3"], ["--target", "t.urdf"]]
    )

    def check(given):
        servicer, target, words = given
        write("r.urdf", servicer)
        write("t.urdf", target)
        if invoke("new", "out", "--urdf", "r.urdf", *words, keep=True) == 0:
            assert invoke("validate", "out/out.yaml") == 0, "written, but not valid"

    text = st.sampled_from(targets)
    fuzz(
        "new",
        st.one_of(
            st.tuples(mutated_urdf(servicers), text, options),
            st.tuples(mutated_urdf([arm_alone()]), text, st.just(on_a_bus)),
            st.tuples(
                st.sampled_from(servicers), mutated_urdf(targets), st.just(["--target", "t.urdf"])
            ),
            st.tuples(mutated_bytes(servicers[2].encode()), text, options),
        ),
        check,
    )


def test_databases(fuzz):
    # A single sampled number: the map of two takes many seconds.
    mass = {"payload.truth.mass": SMALL["parameters"]["payload.truth.mass"]}
    changes = {
        "cases": 2,
        "overrides": {"duration": 0.02},
        "parameters": mass,
        "factors": {},
        "derive": {},
    }
    good = run_here(write_spec(Path("good.yaml"), **changes), Path("good.db")).read_bytes()

    def check(given):
        write("d.db", given)
        if invoke("campaign", "status", "d.db") == 0:
            invoke(
                "campaign",
                "rerun",
                "d.db",
                "--case",
                "1",
                "--no-recording",
                "--out",
                "out",
                good=(0, 3),
            )
            invoke("campaign", "report", "d.db", "--out", "out")

    fuzz("database", mutated_bytes(good), check)
