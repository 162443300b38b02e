"""The files of a law: what stands in them, and which laws are refused."""

import dataclasses
import itertools
import re
import sys

import numpy as np
import pytest
from c_code import compiled, needs_c
from children import finished
from click.testing import CliRunner

from ffsm_drake import (
    ControlLaw,
    FfsmError,
    PlantModel,
    RunRecord,
    export,
    gain,
    load_scenario,
    simulate,
)
from ffsm_drake.cli import main
from ffsm_drake.plugins.compiled.compiling import llvm
from ffsm_drake.plugins.flight.law import LawFiles
from ffsm_drake.plugins.flight.recorded import recorded
from ffsm_drake.scenario import scenario_to_yaml

SIZES = """
#include <stdio.h>
int main(void)
{
  printf("%zu %zu %zu %zu", sizeof(law_in), sizeof(law_gains), sizeof(law_state), sizeof(law_out));
  return 0;
}
"""


HOLDS = """
#include <stdio.h>
#include <string.h>
int main(void)
{
  law_in in;
  law_state one, other;
  law_out first, second;
  memset(&in, 0, sizeof in);
  in.q[0] = in.q_d[0] = 1.0;
  in.v_d[7] = 0.01;
  in.holds = 1U;
  law_start(&one);
  (void)law_step(&in, &LAW_GAINS, &one, &first);
  other = one;
  (void)law_step(&in, &LAW_GAINS, &one, &first);
  in.holds = 2U;
  (void)law_step(&in, &LAW_GAINS, &other, &second);
  printf("%d %u", memcmp(&first, &second, sizeof first), first.status);
  return 0;
}
"""


@needs_c
@pytest.mark.slow
def test_any_number_but_zero_holds_the_target(tmp_path):
    files = LawFiles.of(load_scenario("tumbling_capture"))
    (tmp_path / "law.h").write_text(files.header)
    (tmp_path / "law.c").write_text(files.source)
    (tmp_path / "holds.c").write_text('#include "law.h"\n' + HOLDS)
    program = compiled(tmp_path, ["law.c", "holds.c"])
    assert finished([str(program)]).stdout == "0 0"


def sizes_in_c(folder, files):
    (folder / "law.h").write_text(files.header)
    (folder / "law.c").write_text(files.source)
    (folder / "sizes.c").write_text('#include "law.h"\n' + SIZES)
    return list(map(int, finished([str(compiled(folder, ["law.c", "sizes.c"]))]).stdout.split()))


@needs_c
@pytest.mark.smoke
@pytest.mark.parametrize("single", [False, True])
def test_the_sizes_that_are_printed_are_those_of_the_structs(tmp_path, single):
    for given in (["controller=tdc"], ["controller=pd_plus", "actuation.limit.joints=20"]):
        files = LawFiles.of(load_scenario("postcapture", given), single=single)
        assert sizes_in_c(tmp_path, files) == list(files.sizes.values())


def test_the_header_tells_what_the_law_is_and_where_it_comes_from():
    scenario = load_scenario("postcapture", ["random_seed=7"])
    header = LawFiles.of(scenario).header
    assert "TDE-AISMC" in header
    assert "equations (6), (9), (10)" in header
    assert "(seed 7)" in header
    assert "1/s^2: gain K_P on the error" in header
    other = LawFiles.of(load_scenario("postcapture", ["random_seed=8"])).header
    hashes = [re.findall(r"\b[0-9a-f]{64}\b", text) for text in (header, other)]
    assert hashes[0] != hashes[1]
    assert len(scenario_to_yaml(scenario)) > 100


def test_a_table_has_the_reference_of_the_run():
    scenario = load_scenario("postcapture", ["duration=0.2"])
    assert LawFiles.of(scenario).reference == "polynomial"
    files = LawFiles.of(scenario, table=True)
    assert files.reference == "table"
    text = files.source.partition("REFERENCE[NUM_REFERENCE][34] = {")[2].partition("};")[0]
    rows = [list(map(float, row.split(","))) for row in re.findall(r"\{([^{}]+)\}", text)]
    data = simulate(scenario, check_stability=False).dataset
    assert len(rows) == 21
    np.testing.assert_array_equal(np.array(rows)[:, :12], data.desired_position.values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Branching(ControlLaw):
    """A law that branches on a measurement."""

    k_d: np.ndarray = gain(20.0, "N m s", "on the rate")

    def step(self, sample, state):
        if sample.e_dot[0] > 0.0:
            return 2.0 * self.k_d * sample.e_dot, state
        return self.k_d * sample.e_dot, state


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hostile(ControlLaw):
    """Names that C has of its own */ int x; /* and others."""

    model: PlantModel
    int_: np.ndarray = gain(5.0, "N m s */ #error", "on the rate \n#error \\")
    register: float = gain(2.0, "", "no word of C", scalar=True)

    def initial_state(self):
        names = ("double", "a b", "a_b", "bad", "last_force", "1st", "größe")
        return {name: np.array([1.0, -0.0, np.inf]) for name in names} | {"none": np.zeros(0)}

    def step(self, sample, state):
        force = self.model.calc_mass_matrix(sample.q) @ sample.a_d + self.int_ * sample.e_dot
        return force * self.register * state["double"][0], state


DRAWS, COUNTS = np.random.default_rng(1), itertools.count(1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drawing(Branching):
    """A law that draws random numbers."""

    def step(self, sample, state):
        return self.k_d * sample.e_dot + DRAWS.normal(), state


@dataclasses.dataclass(frozen=True, kw_only=True)
class Counting(Branching):
    """A law that keeps a number outside its state."""

    def step(self, sample, state):
        return self.k_d * sample.e_dot * next(COUNTS), state


def refused(scenario):
    with pytest.raises(FfsmError) as caught:
        LawFiles.of(scenario)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("law", ["mpc", "nmpc"])
def test_a_law_that_solves_programs_is_refused_with_the_place(law):
    said = refused(load_scenario("postcapture", [f"controller={law}"]))
    assert re.match(rf"controller '{law}' cannot be exported as C: \w+\.py:\d+: ", said)


def test_a_branch_of_a_user_is_refused_with_its_line(tmp_path):
    given = [f"controller={__name__}:Branching"]
    said = refused(load_scenario("postcapture", given))
    place, reason = re.search(r"test_law\.py:(\d+): (.*)", said).groups()
    assert "np.where" in reason
    with open(__file__) as file:
        assert "if sample.e_dot[0] > 0.0" in file.readlines()[int(place) - 1]


@pytest.mark.parametrize("law", ["Drawing", "Counting"])
def test_a_law_that_is_no_function_of_a_sample_is_refused(law):
    said = refused(load_scenario("postcapture", [f"controller={__name__}:{law}"]))
    assert "when traced again: it draws random numbers, reads a clock or keeps values" in said


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("tumbling_capture", ["controller=tvlqr"]),  # a table by sample of a plan
        ("postcapture", ["controller=ffsm_drake.plugins.udp.external:External"]),
    ],
)
def test_what_else_is_no_c_is_refused_in_a_line(name, given):
    assert refused(load_scenario(name, given))


@needs_c
def test_names_and_texts_of_a_user_do_no_harm(tmp_path):
    files = LawFiles.of(load_scenario("postcapture", [f"controller={__name__}:Hostile"]))
    assert sizes_in_c(tmp_path, files) == list(files.sizes.values())


def test_the_command_writes_both_files_and_the_verb_reads_a_run(tmp_path):
    line = ["export", str(tmp_path / "own.c"), "postcapture", "-c", "tdc"]
    done = CliRunner().invoke(main, line)
    assert done.exit_code == 0, done.output
    assert '#include "own.h"' in (tmp_path / "own.c").read_text()
    assert "law_state 192" in done.output
    record = simulate(load_scenario("postcapture", ["duration=0.1", "controller=tdc"]))
    record.save(tmp_path / "run")
    export(tmp_path / "again.c", tmp_path / "run")
    export(tmp_path / "own.c", RunRecord.load(tmp_path / "run"))
    again = (tmp_path / "again.c").read_text().replace("again.h", "own.h")
    assert again == (tmp_path / "own.c").read_text()


def test_a_law_that_cannot_be_exported_leaves_no_file(tmp_path):
    done = CliRunner().invoke(main, ["export", str(tmp_path / "l.c"), "postcapture", "-c", "mpc"])
    assert done.exit_code == 2
    assert done.output.startswith("error: controller 'mpc' cannot be exported as C: ")
    assert list(tmp_path.iterdir()) == []


def test_without_llvmlite_the_replay_is_that_of_a_run_on_drake(monkeypatch):
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    llvm.cache_clear()
    try:
        assert not recorded(load_scenario("postcapture", ["duration=0.05"]), ()).exact
    finally:
        llvm.cache_clear()
