"""The skeletons of a kit, for cFS and F Prime, get the inputs of a recorded flight, over stand-ins
of the two frameworks.
"""

import re
from pathlib import Path

import pytest
from c_code import FLAGS, compiled
from flight_kit import exported, need, run

CFE = Path(__file__).parent / "cfe"
FPRIME = Path(__file__).parent / "fprime"


@pytest.mark.slow
def test_the_cfs_application_flies_a_recorded_run(tmp_path):
    need("gcc")
    exported(tmp_path, "postcapture", "controller=tde_aismc", "duration=2")
    sources = [CFE / "driver.c", tmp_path / "recording.c", tmp_path / "law.c"]
    text = run(tmp_path, compiled(tmp_path, sources, f"-I{CFE}", f"-I{tmp_path}"))
    assert "event law: started\n" in text
    assert text.count("event law: a message of %u bytes, not %u") == 1
    found = re.search(r"exit 1, 201 forces, refused 1, ratio (\S+)\n", text)
    assert found, text
    assert float(found[1]) < 1e-9


@pytest.mark.slow
def test_the_f_prime_component_flies_a_recorded_run(tmp_path):
    need("gcc", "g++")
    exported(tmp_path, "postcapture", "controller=tde_aismc", "duration=2")
    run(tmp_path, "gcc", *FLAGS, "-c", "recording.c", "law.c")
    folders = [f"-I{folder}" for folder in (FPRIME, tmp_path, tmp_path / "fprime")]
    flags = ["-std=c++14", *FLAGS[1:], *folders]
    sources = ["fprime/Law.cpp", FPRIME / "driver.cpp", "recording.o", "law.o"]
    run(tmp_path, "g++", *flags, *sources, "-o", "made")
    flight, missing = run(tmp_path, tmp_path / "made").splitlines()
    found = re.fullmatch(r"201 forces, status 0, changes 0, ratio (\S+)", flight)
    assert found, flight
    assert float(found[1]) < 1e-9
    assert missing == "without a measurement: status 1, causes 1, changes 1, moved by 0"
