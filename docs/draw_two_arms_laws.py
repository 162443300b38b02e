"""Draw the laws of the paper on captures by two hands, from the database of a campaign.

python docs/draw_two_arms_laws.py out/campaigns/two_arms_laws.db docs/two_arms_laws.png
"""

import sqlite3
import sys

from matplotlib.figure import Figure

from ffsm_drake.show.style import SERIES, label_of

# expression in the database -> title
PANELS = {
    "itae": "ITAE",
    "1e3 * final_error_joints": "final error of the joints [mrad]",
    "isv": "ISV",
    "1e3 * propellant": "propellant [g]",
}


def main() -> None:
    database, file = sys.argv[1:]
    with sqlite3.connect(database) as connection:
        laws = [name for (name,) in connection.execute("select distinct controller from runs")]
        figure = Figure(figsize=(10.0, 3.0), layout="constrained")
        for axes, (column, title) in zip(figure.subplots(1, 4), PANELS.items(), strict=True):
            for k, law in enumerate(laws):
                found = connection.execute(
                    f"select {column} from runs where controller = ? and outcome = 'settled'",
                    (law,),
                )
                values = sorted(value for (value,) in found)
                spread = [k + 0.5 * (i + 0.5) / len(values) - 0.25 for i in range(len(values))]
                axes.plot(spread, values, ".", color=SERIES[k], markersize=4)
            names = [label_of(law).removesuffix(" (proposed)") for law in laws]
            axes.set_xticks(range(len(laws)), names, fontsize=7, rotation=20)
            axes.set_title(title, fontsize=9)
            axes.set_ylim(0.0, 1.05 * axes.get_ylim()[1])
            axes.tick_params(axis="y", labelsize=7)
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    main()
