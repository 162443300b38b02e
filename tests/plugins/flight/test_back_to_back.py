"""The C of a law commands the force of the compiled run at each sample, bit for bit: every
traceable law on three spacecraft, in drawn scenarios, replayed over a whole run. Powers and
exponentials of another C library differ in the last places.
"""

import os
import re
import shutil

import pytest
from c_code import COMPILERS, compiled, needs_c, needs_llvm
from children import finished
from drawn_laws import CRAFT, TRACEABLE, drawn, users_scenario

from ffsm_drake import FfsmError, export, load_scenario

pytestmark = needs_llvm
DRAWS = int(os.environ.get("FFSM_DRAWS", len(TRACEABLE) * len(CRAFT)))
ARM = shutil.which("arm-linux-gnueabihf-gcc") and shutil.which("qemu-arm")
BUILDS = [(name, level, []) for name in COMPILERS for level in ("-O0", "-O2")]
if ARM:
    BUILDS += [("arm-linux-gnueabihf-gcc", level, ["qemu-arm"]) for level in ("-O0", "-O2")]


@pytest.fixture(scope="module")
def courier(tmp_path_factory):
    return users_scenario(tmp_path_factory.mktemp("courier"))


@needs_c
@pytest.mark.long
@pytest.mark.parametrize("draw", range(DRAWS))
def test_the_forces_of_a_drawn_law_are_equal(draw, tmp_path, courier):
    law = tmp_path / "law.c"
    try:
        said = export(law, drawn(draw, courier), kit=True)
    except FfsmError as error:  # a drawn loop may be unstable
        if "diverged" not in str(error):
            raise
        said = export(law, drawn(draw, courier, gently=True), kit=True)
    compiler, level, runner = BUILDS[draw % len(BUILDS)]
    static = ["-static"] if runner else []
    sources = ["replay.c", "recording.c", "law.c"]
    program = compiled(tmp_path, sources, level, *static, compiler=compiler, name="replay")
    calls = bool(runner) and re.search(
        r"\b(pow|exp|log|tan|tanh|atan2|asin|acos)\(", law.read_text()
    )
    done = finished([*runner, str(program), *(["1e-9"] if calls else [])], cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    rounds = bool(calls) or "within rounding" in " ".join(said)  # a run of Drake is replayed
    assert (
        "passed: within the tolerance" if rounds else "passed: equal bit for bit"
    ) in done.stdout


@needs_c
@pytest.mark.long
@pytest.mark.parametrize("level", ["-O0", "-O2"])
def test_the_forces_of_a_law_within_barriers_are_equal(level, tmp_path):
    """Also where the barriers act."""
    barriers = "command_filter.barriers={margin: 0.2, rate: 0.08}"
    given = ["controller=tdc", "duration=3", "reference.duration=4", barriers]
    export(tmp_path / "law.c", load_scenario("postcapture", given), kit=True)
    program = compiled(tmp_path, ["replay.c", "recording.c", "law.c"], level, name="replay")
    done = finished([str(program)], cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed: equal bit for bit" in done.stdout


@needs_c
@pytest.mark.long
def test_the_forces_of_a_law_in_a_closed_chain_are_equal(tmp_path):
    """It reads the wrench at the other hand."""
    given = ["duration=2", "chain.force={share: 0.5, preload: [0, 0, 1, 0, 0, 5]}"]
    export(tmp_path / "law.c", load_scenario("two_arms", given), kit=True)
    program = compiled(tmp_path, ["replay.c", "recording.c", "law.c"], "-O0", name="replay")
    done = finished([str(program)], cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed: equal bit for bit" in done.stdout
