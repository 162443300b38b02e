"""Self-contained HTML pages: one Jinja environment, one stylesheet, embedded Plotly figures."""

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from plotly.io.json import to_json_plotly  # type: ignore[import-untyped]

from ffsm_drake.common.numbers import counted
from ffsm_drake.show.chart import Curve, View
from ffsm_drake.show.panels import TEMPLATE, panel_data
from ffsm_drake.show.style import PAGE, label_of

_SYMBOL = re.compile(r"(?<![\w.])(K|G|s|q|τ|β|beta|N\*)_(si|s|d\d|[iDPd])\b")

# Points of all lines of a page together, and bounds on those of a line: enough for zooming in.
_MOST_POINTS, _POINTS_PER_LINE = 800_000, (400, 4000)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Section:
    """A plug-in's section of the report: its text, and its views by name."""

    html: Markup
    views: Sequence[View] = ()


def render(
    template: str,
    content: Mapping[str, Any],
    *,
    package: str,
    views: Mapping[str, Sequence[View]] = MappingProxyType({}),
) -> Markup:
    """Return a self-contained page, or a section of one.

    Args:
      template: file in the folder ``templates`` of the package, or of the show room.
      content: variables of the template.
      package: name of the package.
      views: charts of the page by section; with any, the page has plotly.js.
    """
    plots = {"plots": _embedded(views)} if views else {}
    page = _environment(package).get_template(template)
    return Markup(page.render(content, views=views, **plots))


@functools.cache
def _environment(package: str) -> Environment:
    """Return the environment of a package's templates; it compiles each once."""
    folders = dict.fromkeys((package, "ffsm_drake.show"))
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(name, "templates") for name in folders]),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"symbols": symbols, "label": label_of, "counted": counted}
    environment.globals |= {"palette": PAGE, "plotly_script": plotly_script}
    return environment


def plotly_script() -> Markup:
    """plotly.js itself, for a script element."""
    from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]

    return Markup(get_plotlyjs().replace("</script", "<\\/script"))


def lines_of(sections: Mapping[str, Sequence[View]]) -> tuple[list[Curve], int]:
    """Return the lines of a page, and the largest number of points that it draws of each."""
    lines = [
        curve
        for views in sections.values()
        for view in views
        for chart in view.charts
        for curve in chart.curves
        if curve.line and not curve.filled
    ]
    return lines, int(np.clip(_MOST_POINTS // max(len(lines), 1), *_POINTS_PER_LINE))


def _embedded(sections: Mapping[str, Sequence[View]]) -> Markup:
    """Return the figures of a page as JSON, keyed by section, view and panel (``error-0-3``)."""
    _, points = lines_of(sections)
    figures = {
        f"{key}-{i}-{k}": panel_data(chart, points)
        for key, views in sections.items()
        for i, view in enumerate(views)
        for k, chart in enumerate(view.charts)
    }
    # Nothing in it closes the script element or opens another.
    return Markup(to_json_plotly({"template": TEMPLATE, "figures": figures}, engine="json"))


def symbols(text: str) -> Markup:
    """Return text with subscripts of symbols as HTML."""
    return Markup(_SYMBOL.sub(r"\1<sub>\2</sub>", str(escape(text))))
