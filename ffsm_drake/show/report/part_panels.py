"""The report's panels of parts: a view for each signal, a panel for each of its components."""

from collections.abc import Sequence

from ffsm_drake.runs.dataset import PART
from ffsm_drake.show.panels import Panel, Thinning, View, time_panel
from ffsm_drake.show.report.results import Result
from ffsm_drake.show.report.time_panels import run_curve


def part_views(results: Sequence[Result], thin: Thinning) -> list[View]:
    """Views of the signals of the parts of the runs; none for runs without."""
    signals = {
        str(name): variable.attrs
        for result in results
        for name, variable in result.record.dataset.data_vars.items()
        if PART in variable.attrs
    }
    return [
        View(
            label=f"{attributes[PART]}: {name.replace('_', ' ')}",
            panels=_panels(results, thin, name, attributes["units"]),
        )
        for name, attributes in signals.items()
    ]


def _panels(results: Sequence[Result], thin: Thinning, name: str, unit: str) -> list[Panel]:
    """A panel for each component of a signal, the runs that have it overlaid."""
    traces: dict[str, list[dict[str, object]]] = {}
    for i, result in enumerate(results):
        data = result.record.dataset
        if name not in data:
            continue
        values, time = data[name].values, data["time"].values
        components = data[data[name].dims[1]].values.tolist() if values.ndim == 2 else [name]
        columns = values.T if values.ndim == 2 else [values]
        for component, column in zip(components, columns, strict=True):
            curve = run_curve(results, i, thin(time, column))
            traces.setdefault(str(component), []).append(curve)
    return [time_panel(title.replace("_", " "), unit, curves) for title, curves in traces.items()]
