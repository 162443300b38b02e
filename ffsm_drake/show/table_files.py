"""Tables as files, for papers and spreadsheets: LaTeX (booktabs) and CSV."""

import csv
import dataclasses
import io
import math
from collections.abc import Sequence
from pathlib import Path

from ffsm_drake.common.files import write_text
from ffsm_drake.common.numbers import NONE

FORMATS = (".tex", ".csv")
_SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    NONE: "--", "µ": r"\textmu{}", **{sign: f"\\{sign}" for sign in "&%$#_{}"},
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Column:
    """A column of a table: a text or a number for each row; NaN and None are empty cells."""

    name: str
    unit: str = ""
    cells: Sequence[str | float | None]
    digits: int = 3  # significant ones of its numbers, in LaTeX

    @property
    def heading(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def write_table(columns: Sequence[Column], path: Path) -> Path:
    """Write a table to a file, in the format of its suffix, one of ``FORMATS``. Returns the path.

    Raises:
      RecordError: the file cannot be written.
    """
    write_text(path, _latex(columns) if path.suffix == ".tex" else _csv(columns))
    return path


def _csv(columns: Sequence[Column]) -> str:
    """Numbers with eight digits."""
    text = io.StringIO()
    rows = zip(*(column.cells for column in columns), strict=True)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.heading for column in columns])
    writer.writerows(
        [cell if isinstance(cell, str) else "" if _empty(cell) else f"{cell:.8g}" for cell in row]
        for row in rows
    )
    return text.getvalue()


def _latex(columns: Sequence[Column]) -> str:
    """Return a tabular in booktabs' style: texts to the left, numbers to the right."""
    cells = [[_latex_cell(cell, column.digits) for cell in column.cells] for column in columns]
    texts = (any(isinstance(cell, str) for cell in column.cells) for column in columns)
    heads = [[_escaped(column.name) for column in columns]]
    if any(column.unit for column in columns):
        units = (_escaped(column.unit).replace(" ", r"\,") for column in columns)
        heads.append([f"[{unit}]" if unit else "" for unit in units])
    lines = [
        r"% needs \usepackage{booktabs}",
        rf"\begin{{tabular}}{{{''.join('l' if text else 'r' for text in texts)}}}",
        r"\toprule",
        *(rf"{' & '.join(head)} \\" for head in heads),
        r"\midrule",
        *(rf"{' & '.join(row)} \\" for row in zip(*cells, strict=True)),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _latex_cell(cell: str | float | None, digits: int) -> str:
    if isinstance(cell, str):
        return _escaped(cell)
    if _empty(cell):
        return _SPECIAL[NONE]
    if isinstance(cell, int):
        return f"${cell}$"
    text = f"{cell:#.{digits}g}".removesuffix(".")
    if "e" not in text:
        return f"${text}$"
    number, power = text.split("e")
    return rf"${number.removesuffix('.')} \times 10^{{{int(power)}}}$"


def _empty(cell: float | None) -> bool:
    return cell is None or not math.isfinite(cell)


def _escaped(text: str) -> str:
    """Escape all characters that are commands in LaTeX."""
    return "".join(_SPECIAL.get(sign, sign) for sign in text)
