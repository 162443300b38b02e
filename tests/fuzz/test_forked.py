"""Scenarios and URDFs made at random from good ones load, or are refused in one line."""

import collections
from pathlib import Path

import pytest
import yaml
from alone import run_alone
from fuzz.forked import drawn, unclean
from fuzz.fuzz_inputs import mutated_bytes, mutated_data, mutated_urdf
from hypothesis import strategies as st

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.scenario import scenario_from_yaml, shipped_scenarios
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.craft import make_true_plant
from ffsm_drake.spacecraft.plant import models_dir

URDFS = [
    (models_dir() / "urdf" / f"{name}.urdf").read_text()
    for name in ("servicer", "debris", "ssrms_servicer")
]
SCENARIOS = [
    yaml.safe_load(path.read_text()) | {"duration": 0.02} for path in shipped_scenarios().values()
]
WORDS = st.sampled_from(
    ['"a::b"', '"1e300"', '"1e300 0 0"', '"1e-300"', '"nan nan nan"', '"\xe9"', '"inf"', '"."']
)


@st.composite
def hostile_urdf(draw):
    """A mutated URDF in some encoding, with any attribute replaced, or nested or repeated."""
    text = draw(mutated_urdf(URDFS))
    kind = draw(st.sampled_from(["", "", "word", "word", "nest", "repeat", "bytes"]))
    pieces = text.split('"')
    if kind == "word" and len(pieces) > 2:
        at = 2 * draw(st.integers(0, (len(pieces) - 3) // 2)) + 1
        pieces[at] = draw(WORDS).strip('"')
        text = '"'.join(pieces)
    elif kind == "nest":
        text = text.replace("<link", draw(st.sampled_from(["<a>", "<link name='x'>"])) * 3000, 1)
    elif kind == "repeat":
        text = text.replace("</robot>", "<link name='l'/>" * draw(st.integers(1, 900)) + "</robot>")
    encoded = text.encode(draw(st.sampled_from(["utf-8", "utf-8", "latin-1", "utf-16"])), "replace")
    return draw(mutated_bytes(encoded)) if kind == "bytes" else encoded


def load_urdf(file):
    """check(text) that loads a model with it as servicer or debris, its shapes and masses."""

    def check(text):
        file.unlink(missing_ok=True)
        file.write_bytes(text)
        role = "debris" if b'name="grasp"' in text else "servicer"
        name = "seven_joint" if b"ssrms" in text else "postcapture"
        other = {"servicer": "debris", "debris": "servicer"}[role]
        shipped = models_dir() / "urdf" / f"{other}.urdf"
        scenario = load_scenario(name, [f"model.{role}={file}", f"model.{other}={shipped}"])
        make_true_plant(scenario)
        Clearance(scenario.model)

    return check


def load_yaml(text):
    """Read, check, wire, and say what is remarkable."""
    scenario = scenario_from_yaml(text.decode(errors="replace"))
    make_closed_loop(scenario)
    if judge := JUDGES.first():
        judge.remarks(scenario)


HOSTILE_YAML = st.one_of(
    mutated_data(SCENARIOS).map(lambda data: yaml.safe_dump(data, allow_unicode=True).encode(
        "utf-8", "surrogatepass"
    )),
    mutated_bytes(yaml.safe_dump(SCENARIOS[0]).encode()),
)  # fmt: skip


@pytest.mark.parametrize("count", [100, pytest.param(5000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("area", ["urdf", "scenario"])
def test_hostile_inputs_end_cleanly(area, count, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_alone(inputs_end_cleanly, area, count, inputs=count)


def inputs_end_cleanly(area, count):
    strategy, check = {
        "urdf": (hostile_urdf(), load_urdf(Path("r.urdf").resolve())),
        "scenario": (HOSTILE_YAML, load_yaml),
    }[area]
    inputs = drawn(strategy, count)
    found = unclean(inputs, check)
    counts = collections.Counter(found.values())
    examples = {text: inputs[index] for index, text in found.items()}
    assert not found, f"{len(found)} of {len(inputs)}: {counts}; such as {examples}"


def executed(given):
    exec(given)


@pytest.mark.smoke
def test_what_is_unclean_is_seen():
    """An abort, a traceback, too much memory and a text of no line, each with its input."""
    inputs = ["1", "import os; os.abort()", "1 / 0", "bytearray(2**40)", "2"]
    found = run_alone(unclean, inputs, executed)
    assert found.keys() == {1, 2, 3}
    assert found[1] == "ended by SIGABRT"
    assert found[2].startswith("ZeroDivisionError")
    assert found[3].startswith("MemoryError")
