"""Everything that a campaign's report shows, computed once."""

import dataclasses
from collections.abc import Callable

from ffsm_drake.campaign.spec import Spec
from ffsm_drake.campaign.stability_map import StabilityMap, predict_map
from ffsm_drake.campaign.statistics import (
    Agreement,
    Difference,
    Interval,
    Sensitivity,
    Table,
    agreement,
    most_influential,
    paired_differences,
    read_table,
    sensitivities,
    success_rate,
)
from ffsm_drake.campaign.store import Store


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """The evaluation of a campaign."""

    spec: Spec
    table: Table
    success: dict[str, Interval]  # by controller
    differences: list[Difference]
    sensitivities: list[Sensitivity]
    influential: list[str]  # sampled numbers, most influential first
    agreement: list[Agreement]
    map: StabilityMap | None  # None with fewer than two sampled numbers

    @property
    def runs(self) -> int:
        return sum(runs.case.size for runs in self.table.runs.values())


def find(
    store: Store, *, axes: tuple[str, str] | None = None, progress: Callable[[int, int], None] | None = None
) -> Findings:
    """Evaluate the results that a database holds so far.

    Args:
      store: the database.
      axes: the map's two values; None for the two most influential.
      progress: called with (done, total) controllers of the map.

    Raises:
      CampaignError: an axis is not a sampled number.
    """
    spec, table = store.spec, read_table(store)
    found = sensitivities(table, seed=spec.seed)
    influential = most_influential(found)
    if axes is None and len(influential) >= 2:
        axes = (influential[0], influential[1])
    return Findings(
        spec=spec,
        table=table,
        success={name: success_rate(runs) for name, runs in table.runs.items()},
        differences=paired_differences(table, seed=spec.seed),
        sensitivities=found,
        influential=influential,
        agreement=[agreement(runs) for runs in table.runs.values()],
        map=None if axes is None else predict_map(spec, axes, table.values, progress=progress),
    )
