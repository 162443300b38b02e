"""The targets of a kit's Makefile: compilers, ARM, sanitizers, fuzzing, coverage, reports."""

import re

import pytest
from flight_kit import exported, make, need

from ffsm_drake.plugins.flight.kit import write_kit

ARM = ("arm-linux-gnueabihf-gcc", "qemu-arm")
PASSED = "passed: equal bit for bit"


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    """The paper's law with its whole run."""
    need("gcc", "make")
    return exported(tmp_path_factory.mktemp("kit"), "postcapture", "controller=tde_aismc")


@pytest.mark.slow
def test_gcc_without_and_with_optimization(kit):
    text = make(kit, "check")
    assert text.count(PASSED) == 2
    assert text.count("samples: 2001, not LAW_OK: 0") == 2


@pytest.mark.long
def test_clang(kit):
    need("clang")
    assert make(kit, "clang").count(PASSED) == 2


@pytest.mark.long
def test_arm(kit):
    need(*ARM)
    assert make(kit, "arm").count(PASSED) == 2


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "count"),
    [
        ("postcapture", 1_000_000),
        ("tumbling_capture", 200_000),
        ("flight_sensors", 200_000),
        ("thrusters_and_wheels", 200_000),
    ],
)
def test_hostile_samples_under_sanitizers(tmp_path, scenario, count):
    need("gcc")
    text = make(exported(tmp_path, scenario), "sanitize", f"COUNT={count}")
    assert int(re.search(r"of them hostile: (\d+)\n", text)[1]) >= count
    text = text.partition("of them hostile")[2]
    assert "\npassed\n" in text
    for status in ("LAW_OK", "LAW_HOLDS", "LAW_ZERO", "anew"):
        assert int(re.search(rf"{status}: (\d+)", text)[1]) > count / 1000


@pytest.mark.long
@pytest.mark.parametrize("float32", [False, True])
def test_single_precision_and_a_table_survive_hostile_samples(tmp_path, float32):
    need("gcc")
    folder = exported(tmp_path, "postcapture", "controller=tde_aismc", float32=float32, table=True)
    assert "passed" in make(folder, "sanitize", "COUNT=200000")


@pytest.mark.long
def test_the_fuzz_target_of_libfuzzer(kit):
    need("clang")
    text = make(kit, "libfuzzer", "COUNT=20000")
    assert "Done 20000 runs" in text


@pytest.mark.long
def test_replay_and_fuzz_cover_each_line_and_branch(kit):
    need("gcc", "gcov")
    text = make(kit, "coverage", "COUNT=300000").partition("File 'law.c'")[2]
    for what in ("Lines executed", "Branches executed", "Taken at least once", "Calls executed"):
        assert re.search(rf"{what}:100.00% of \d+\n", text), text


@pytest.mark.slow
def test_sizes(kit):
    text = make(kit, "size")
    assert re.search(r"largest stack of a function: \d+ bytes, law.c:\d+:\d+:\w+\n", text)
    assert re.search(r"\d+ operations", text)


@pytest.mark.parametrize("target", ["check", "clang", "arm", "coverage", "misra"])
def test_a_missing_tool_gives_one_line(tmp_path, target):
    need("make")
    write_kit(tmp_path, "law", "")
    for name in ("law.c", "law.h"):
        (tmp_path / name).touch()
    names = ("CC", "CLANG", "ARM_CC", "CPPCHECK")
    text = make(tmp_path, target, *(f"{name}=no_such_tool" for name in names), code=2)
    lines = [line for line in text.splitlines() if "no_such_tool" in line]
    assert lines == [f"make {target}: no_such_tool is missing; install it"]
