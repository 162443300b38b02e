"""``ffsm export FILE.c``: the files of a law in C."""

from pathlib import Path

from ffsm_drake.common.files import write_text
from ffsm_drake.plugins.flight.kit import write_kit
from ffsm_drake.plugins.flight.law import LawFiles
from ffsm_drake.plugins.flight.recorded import recorded
from ffsm_drake.scenario import Scenario


def write_c(
    scenario: Scenario, path: Path, float32: bool = False, table: bool = False, kit: bool = False
) -> list[str]:
    """Write a scenario's law to ``path`` and the header beside it.

    Args:
      scenario: the scenario.
      path: of the source file, which ends in .c.
      float32: in single precision.
      table: the reference as a table, even if it is a polynomial.
      kit: also write what proves and flies it, see ``write_kit``.

    Returns: a line for each thing to know.

    Raises FfsmError: the law cannot be exported, or the run for the replay fails.
    """
    header = path.with_suffix(".h")
    made = LawFiles.of(scenario, single=float32, table=table, header=header.name)
    precision = "single" if float32 else "double"
    sizes = ", ".join(f"{name} {size}" for name, size in made.sizes.items())
    reference = made.reference or "given by the caller"
    lines = [
        f"{path}, {header.name}: the law {scenario.controller} in C99, {precision} precision",
        f"{made.operations} operations a sample; bytes: {sizes}; reference: {reference}",
    ]
    if kit:
        run = recorded(scenario, made.reads)
        files = write_kit(path.parent, path.stem, run.text())
        equal = "bit for bit" if run.exact and not float32 else "within rounding"
        lines.append(f"kit: {', '.join(str(each.relative_to(path.parent)) for each in files)}")
        lines.append(f"make -C {path.parent} check replays a run, which must be equal {equal}")
    write_text(header, made.header)
    write_text(path, made.source)
    return lines
