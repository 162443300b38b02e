"""The tutorial docs/flight_code.md: its commands run as they stand, and print what it quotes."""

import re
import shutil
from pathlib import Path

import pytest
from c_code import needs_c, needs_llvm
from children import STDOUT, finished
from flight_kit import need

PAGE = Path(__file__).parents[3] / "docs/flight_code.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.M | re.S)
MINUTES = 300.0  # s that the commands of a block may take


def pieces(line):
    """The texts of a quoted line, which may leave out some with three dots."""
    return [each.strip() for each in line.split("...") if each.strip()]


@pytest.mark.long
@needs_c
@needs_llvm
def test_the_commands_print_what_the_tutorial_quotes(tmp_path):
    need("make")
    printed, quotes = "", 0
    for language, text in BLOCK.findall(PAGE.read_text()):
        if (name := re.match(r"(?:# |/\* )(\w+\.\w+)", text)) is not None:
            (tmp_path / name[1]).write_text(text)
        elif language == "sh" and not text.startswith("pip "):
            command = "set -m\n" + text.replace("./build/fly &\n", "./build/fly & sleep 1\n")
            line = ["bash", "-c", f"{command}wait"]
            done = finished(line, longest=MINUTES, cwd=tmp_path, stderr=STDOUT)
            printed = done.stdout
            assert done.returncode in (0, 143), f"{text}: {printed[-2000:]}"
        elif language == "text" and not text.startswith("error: "):
            for piece in (piece for line in text.splitlines() for piece in pieces(line)):
                assert piece in printed, printed[-3000:]
                quotes += 1
        elif language == "c":  # of the header
            assert text in (tmp_path / "law.h").read_text()
    assert quotes > 15


@pytest.mark.slow
def test_the_refusal_in_the_tutorial_is_that_of_the_command(tmp_path):
    text = PAGE.read_text()
    (quoted,) = re.findall(r"^error: .*$", text, re.M)
    (law,) = (text for _, text in BLOCK.findall(text) if text.startswith("# flight_law.py"))
    changed = law.replace(
        "        return force +",
        "        if force[0] > 1:\n            force *= 0\n        return force +",
    )
    assert changed != law
    (tmp_path / "flight_law.py").write_text(changed)
    line = [shutil.which("ffsm"), "export", "law.c", "flight_sensors", "-c", "flight_law:Pid"]
    done = finished(line, longest=MINUTES, cwd=tmp_path)
    assert done.returncode == 2
    for piece in pieces(quoted):
        assert piece in done.stderr
