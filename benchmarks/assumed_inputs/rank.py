"""Rank the drawn figures of campaigns by what they explain of failure, ITAE and ISV.

    python benchmarks/assumed_inputs/rank.py out/campaigns/gripper.db

The share is the part of the variance that the means of equally filled bins of one figure explain.
ITAE and ISV count by their ranks, among the runs that did not end early. The level of chance is the
95 % quantile of the largest share of any figure if the output is shuffled among the cases, so
that all figures of a campaign together have a false alarm in one of twenty campaigns.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from ffsm_drake.plugins.campaign.statistics import Table, read_table
from ffsm_drake.plugins.campaign.store import open_store

SHUFFLES = 1000
COMPLETE = ("settled", "not_settled", "growing")


def in_bins(values: pd.DataFrame) -> list[np.ndarray]:
    """Return for each figure the averaging matrix (bins, n) of its bins."""
    count = len(values)
    most = max(2, min(8, count // 12))
    found = []
    for name in values:
        order = values[name].rank(method="average").to_numpy()
        bins = np.minimum(((order - 0.5) * most / count).astype(int), most - 1)
        members = (np.unique(bins)[:, None] == bins).astype(float)
        found.append(members / np.sqrt(members.sum(axis=1, keepdims=True)))
    return found


def shares(bins: list[np.ndarray], outputs: np.ndarray) -> np.ndarray:
    """Return the explained shares (figures, m) of the variance of outputs (n, m)."""
    centred = outputs - outputs.mean(axis=0)
    total = (centred**2).sum(axis=0)
    explained = np.array([((means @ centred) ** 2).sum(axis=0) for means in bins]) / total
    lost = np.array([len(means) - 1 for means in bins])[:, None] / (len(outputs) - 1)
    return (explained - lost) / (1 - lost)


def outputs_of(runs: pd.DataFrame) -> dict[str, pd.Series]:
    """Return failure of all runs, and the ranks of ITAE and ISV of the complete ones."""
    complete = runs[runs["outcome"].isin(COMPLETE)]
    ranks = {name: pd.to_numeric(complete[name]).rank() for name in ("itae", "isv")}
    return {"failure": (~runs["is_settled"]).astype(float)} | ranks


def show(table: Table) -> None:
    """Print for each controller the figures that explain more than chance, and the other ones."""
    generator = np.random.default_rng(1)
    for controller, runs in table.runs.items():
        values = table.values.loc[runs.index]
        values = values.loc[:, values.nunique() > 1]
        failed = int((~runs["is_settled"]).sum())
        print(f"{controller}: {failed} failures in {len(runs)} runs, {values.shape[1]} figures")
        print("  ", dict(runs["outcome"].value_counts()))
        for output, numbers in outputs_of(runs).items():
            if numbers.nunique() < 2:
                print(f"  {output}: the same in all runs")
                continue
            drawn = values.loc[numbers.index]
            bins = in_bins(drawn)
            shuffled = np.array(
                [generator.permutation(numbers.to_numpy()) for _ in range(SHUFFLES)]
            ).T
            chance = float(np.quantile(shares(bins, shuffled).max(axis=0), 0.95))
            own = pd.Series(shares(bins, numbers.to_numpy()[:, None])[:, 0], drawn.columns)
            signs = drawn.corrwith(numbers, method="spearman")
            print(f"  {output}: {len(numbers)} runs, level of chance {100 * chance:.0f} %")
            own = own.sort_values(ascending=False)
            for name, share in own[own > chance].items():
                print(f"    {name}: {100 * share:.0f} %, rank correlation {signs[name]:+.2f}")
            print(f"    not beyond chance: {', '.join(own[own <= chance].index) or 'none'}")


def main() -> None:
    """Print the ranking of each database."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("databases", nargs="+", type=Path)
    for path in parser.parse_args().databases:
        print(path)
        with open_store(path) as store:
            show(read_table(store))


if __name__ == "__main__":
    main()
