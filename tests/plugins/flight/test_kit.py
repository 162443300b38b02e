"""The kit of an exported law: its replay has the bits of the recorded run and finds each
difference, and its fuzz target finds each broken rule.
"""

import numpy as np
import pytest
from c_code import needs_llvm
from flight_kit import exported, make, need, run

from ffsm_drake import FfsmError, load_scenario
from ffsm_drake.plugins.flight.kit import write_kit
from ffsm_drake.spacecraft.craft import make_nominal_plant

pytestmark = needs_llvm
SHORT = ("controller=tde_aismc", "duration=0.5")


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    need("gcc", "make")
    folder = exported(tmp_path_factory.mktemp("kit"), "postcapture", *SHORT)
    make(folder, "replay", "CFLAGS=-O0")
    make(folder, "fuzz", "CFLAGS=-O0", "COUNT=1")
    return folder


@pytest.mark.smoke
def test_a_replay_has_the_bits_of_the_run(kit):
    text = run(kit, "build/replay-replay")
    assert "samples: 51, not LAW_OK: 0" in text
    assert "forces with other bits: 0 of 561" in text
    assert text.endswith("passed: equal bit for bit\n")
    text = run(kit, "build/replay-replay", "0", "replay.txt", "matrices")
    rows = text.partition("law_mass_matrix at the first sample:\n")[2].splitlines()[:11]
    nominal = make_nominal_plant(load_scenario("postcapture", SHORT))
    first = (kit / "replay.txt").read_text().split("\n")[1].split()
    q = np.array([float.fromhex(each) for each in first[3:15]])
    found = np.array([[float(each) for each in row.split()] for row in rows])
    np.testing.assert_allclose(found, nominal.calc_mass_matrix(q), rtol=1e-12, atol=1e-11)


def changed(kit, line, column, value):
    """A recorded run with another number in the line of a sample."""
    line += 1  # after the tolerance
    lines = (kit / "replay.txt").read_text().splitlines()
    words = lines[line].split()
    words[column] = value(words[column])
    lines[line] = " ".join(words)
    path = kit / "changed.txt"
    path.write_text("\n".join(lines) + "\n")
    return path.name


def test_a_replay_finds_a_difference_in_the_last_place(kit):
    path = changed(kit, 20, -3, lambda word: float(np.nextafter(float.fromhex(word), np.inf)).hex())
    text = run(kit, "build/replay-replay", "0", path, code=1)
    assert "forces with other bits: 1 of 561, by at most 1 units in the last place" in text
    assert "FAILED: forces differ" in text
    text = run(kit, "build/replay-replay", "1e-12", path)
    assert text.endswith("passed: within the tolerance\n")


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        (-1, lambda word: (float.fromhex(word) + 1e-6).hex(), "FAILED: forces differ"),
        (3, lambda _: "nan", "not LAW_OK: 1, the first is 20"),
        (3 + 23, lambda word: (float.fromhex(word) + 1e-6).hex(), "FAILED: law_reference differs"),
    ],
)
def test_a_replay_finds_other_forces_statuses_and_references(kit, column, value, expected):
    path = changed(kit, 20, column, value)
    text = run(kit, "build/replay-replay", "1e-9", path, code=1)
    assert expected in text
    assert "passed" not in text


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        (0, lambda _: "-1", "a line must begin with three whole numbers"),
        (1, lambda _: "1.5", "a line must begin with three whole numbers"),
        (9, lambda _: "x", "too few numbers, or text that is no number"),
        (9, lambda _: "", "too few numbers, or text that is no number"),
        (9, lambda word: f"{word} 0.0", "more numbers than this law has"),
        (9, lambda _: "0" * 4000, "the line is too long"),
    ],
)
def test_a_replay_refuses_a_damaged_file(kit, column, value, expected):
    text = run(kit, "build/replay-replay", "0", changed(kit, 5, column, value), code=2)
    assert text.startswith(f"changed.txt:7: {expected}")
    assert text.count("\n") == 1


@pytest.mark.parametrize("program", ["replay-replay", "fuzz"])
def test_programs_refuse_missing_files_and_wrong_arguments(kit, program):
    arguments = ("0",) if program == "replay-replay" else ("1", "1")
    assert "cannot be opened" in run(kit, f"build/{program}", *arguments, "none.txt", code=2)
    (kit / "empty.txt").write_text("# nothing\n")
    assert "no samples" in run(kit, f"build/{program}", *arguments, "empty.txt", code=2)
    for wrong in (("-1",), ("x",), ("1", "x", "y", "z")):
        assert run(kit, f"build/{program}", *wrong, code=2).startswith("usage: ")


FAULTS = {
    "state->good = 0U;": ("", "rule 3"),
    "copy(made.force, state->last_force, LAW_NV);": ("", "rule "),
    "restart(state); /*": ("/*", "rule 3"),
    "made.causes = causes;": ("", "rule 1"),
    "if (causes == 0U) {\n    made": ("if (1) {\n    made", "rule 2"),
    "*state = next;\n": ("*state = next; state->last_force[0] *= 0.5;\n", "rule 4"),
}


@pytest.mark.slow
@pytest.mark.parametrize("old", FAULTS)
def test_the_fuzz_target_finds_faults_in_the_law(kit, tmp_path, old):
    new, rule = FAULTS[old]
    source = (kit / "law.c").read_text()
    assert source.count(old) == 1
    for name in ("law.h", "fuzz.c", "recording.c", "recording.h", "Makefile", "replay.txt"):
        (tmp_path / name).write_bytes((kit / name).read_bytes())
    (tmp_path / "law.c").write_text(source.replace(old, new))
    text = make(tmp_path, "fuzz", "CFLAGS=-O0 -Wno-error", "COUNT=20000", code=2)
    assert f"FAILED: {rule}" in text


def test_a_kit_keeps_files_that_are_there(tmp_path):
    (tmp_path / "Makefile").write_text("all:\n")
    with pytest.raises(FfsmError, match=r"Makefile is there and differs from the kit's"):
        write_kit(tmp_path, "law", "")
    assert [each.name for each in tmp_path.iterdir()] == ["Makefile"]
    (tmp_path / "Makefile").unlink()
    written = write_kit(tmp_path, "arm_law", "1\n")
    assert all(path.is_file() for path in written)
    assert "\nLAW = arm_law\n" in (tmp_path / "Makefile").read_text()
    for name in ("recording.h", "fly.c", "cfs_app.c", "fprime/Law.hpp"):
        assert '#include "arm_law.h"' in (tmp_path / name).read_text()
    assert written == write_kit(tmp_path, "arm_law", "2\n")
    assert (tmp_path / "replay.txt").read_text() == "# tolerance 0\n2\n"


@pytest.mark.parametrize("stem", ["replay", "fuzz", "my law", "law$(x)", "-law"])
def test_a_law_whose_name_a_kit_cannot_have_is_refused(tmp_path, stem):
    with pytest.raises(FfsmError) as error:
        write_kit(tmp_path, stem, "")
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())
