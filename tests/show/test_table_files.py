"""Tables as files, for papers and spreadsheets."""

import csv
import math

from ffsm_drake.show.table_files import Column, write_table

COLUMNS = [
    Column(name="law", cells=["tde_aismc", "50 % & {more}"]),
    Column(name="ITAE", cells=[1.0412e-6, math.nan], digits=4),
    Column(name="peak force", unit="N m", cells=[123456.0, 2.0]),
    Column(name="runs", cells=[3, None]),
]


def test_latex_escapes_texts_and_writes_powers_of_ten(tmp_path):
    assert (
        write_table(COLUMNS, tmp_path / "new" / "t.tex").read_text()
        == r"""
% needs \usepackage{booktabs}
\begin{tabular}{lrrr}
\toprule
law & ITAE & peak force & runs \\
 &  & [N\,m] &  \\
\midrule
tde\_aismc & $1.041 \times 10^{-6}$ & $1.23 \times 10^{5}$ & $3$ \\
50 \% \& \{more\} & -- & $2.00$ & -- \\
\bottomrule
\end{tabular}
""".lstrip()
    )


def test_csv_keeps_eight_digits_and_leaves_gaps_empty(tmp_path):
    rows = list(csv.reader(write_table(COLUMNS, tmp_path / "t.csv").read_text().splitlines()))
    assert rows == [
        ["law", "ITAE", "peak force [N m]", "runs"],
        ["tde_aismc", "1.0412e-06", "123456", "3"],
        ["50 % & {more}", "", "2", ""],
    ]
