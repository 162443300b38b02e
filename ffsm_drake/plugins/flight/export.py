"""``ffsm export FILE.c``: the files of a law in C."""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.files import write_text
from ffsm_drake.plugins.flight.kit import write_kit
from ffsm_drake.plugins.flight.law import LawFiles
from ffsm_drake.plugins.flight.recorded import recorded
from ffsm_drake.scenario import Scenario

_ROUNDING = 1e-9  # tolerance of a replay of a run on Drake, as a share of the largest force
_LONGEST = 300.0  # s


def write_c(
    scenario: Scenario, path: Path, float32: bool = False, table: bool = False, kit: bool = False
) -> list[str]:
    """Write a scenario's law to ``path`` and the header beside it.

    Args:
      scenario: the scenario.
      path: of the source file, which ends in .c.
      float32: in single precision, with the loss that a C compiler and a run show.
      table: the reference as a table, even if it is a polynomial.
      kit: also write what proves and flies it, see ``write_kit``.

    Returns: a line for each thing to know.

    Raises FfsmError: the law cannot be exported, or the run for the replay fails.
    """
    header = path.with_suffix(".h")
    made = LawFiles.of(scenario, single=float32, table=table, header=header.name)
    sizes = ", ".join(f"{name} {size}" for name, size in made.sizes.items())
    lines = [
        f"{path}, {header.name}: the law {scenario.controller} in C99, "
        f"{'single' if float32 else 'double'} precision",
        f"{made.operations} operations a sample; bytes: {sizes}; reference: "
        f"{made.reference or 'given by the caller'}",
    ]
    if kit or float32:
        run = recorded(scenario, made.reads)
        tolerance, equal = (0.0, "bit for bit") if run.exact else (_ROUNDING, "within rounding")
        if float32:
            loss = _loss(made, header.name, run.text())
            tolerance, equal = (2.0 * loss or 1.0, f"within {200.0 * loss:.2g} %")
            lines.append("single precision: the force of a run differs by up to "
                         f"{100.0 * loss:.2g} % of the largest force of its kind")  # fmt: skip
    if kit:
        files = write_kit(path.parent, path.stem, run.text(), tolerance=tolerance)
        lines.append(f"kit: {', '.join(str(each.relative_to(path.parent)) for each in files)}")
        place = "" if path.parent == Path() else f" -C {path.parent}"
        lines.append(f"make{place} check replays a recorded run; forces must be equal {equal}")
    write_text(header, made.header)
    write_text(path, made.source)
    return lines


def _loss(made: LawFiles, header: str, replay: str) -> float:
    """The largest difference of a force in a replay, as a share of the largest of its kind. Raises
    FfsmError: there is no C compiler.
    """
    if (compiler := shutil.which("cc") or shutil.which("gcc")) is None:
        raise FfsmError("--float32: needs a C compiler (cc), which measures the loss")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_kit(folder, "law", replay)
        write_text(folder / "law.h", made.header)
        write_text(folder / "law.c", made.source.replace(f'"{header}"', '"law.h"'))
        files = ["replay.c", "recording.c", "law.c", "-lm", "-o", "replay"]
        for line in ([compiler, "-std=c99", "-O1", *files], ["./replay", "1"]):
            try:
                done = subprocess.run(
                    line, cwd=folder, capture_output=True, text=True, timeout=_LONGEST
                )
            except subprocess.TimeoutExpired as error:
                raise FfsmError(f"--float32: {line[0]} takes more than {_LONGEST:g} s") from error
            why = " ".join((done.stderr or done.stdout).split())[:100]
            if done.returncode != 0 and line[0] == compiler:
                raise FfsmError(f"--float32: {compiler} cannot compile the law ({why})")
        found = re.findall(r"ratio ([^\s]+)", done.stdout)
        if not found:
            raise FfsmError(f"--float32: the replay of a run fails ({why})")
        return max(map(float, found))
