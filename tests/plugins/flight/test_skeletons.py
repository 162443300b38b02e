"""The skeletons of a kit: the cFS application runs a recorded flight over a stand-in of cFE."""

import re
from pathlib import Path

import pytest
from c_code import compiled
from flight_kit import exported, need, run

CFE = Path(__file__).parent / "cfe"


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
