"""Self-contained HTML pages: one Jinja environment, one stylesheet, embedded Plotly figures."""

import dataclasses
import functools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from ffsm_drake.common.numbers import counted
from ffsm_drake.show.panels import TEMPLATE, View
from ffsm_drake.show.style import PAGE, label_of

_SYMBOL = re.compile(r"(?<![\w.])(K|G|s|q|τ|β|beta|N\*)_(si|s|d\d|[iDPd])\b")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Section:
    """A plug-in's section of the report: its text, and its views by name.

    It comes from a service ``report_NAME``, a function of the results and the page's ``Thinning``.
    """

    html: Markup
    views: Sequence[View] = ()


def render(template: str, content: Mapping[str, Any], *, package: str = "ffsm_drake.show") -> str:
    """Return a self-contained page, or a section of one, as text.

    ``template`` is a file in the package's folder ``templates`` (or the show room's), ``content``
    its variables; ``plots``, from ``embedded``, adds plotly.js.
    """
    return _environment(package).get_template(template).render(content)


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


def embedded(sections: Mapping[str, Iterable[View]]) -> Markup:
    """Return figures of a page's sections as JSON, keyed by section, view and panel
    (``error-0-3``).
    """
    figures = {
        f"{key}-{i}-{k}": panel.figure.to_plotly_json()
        for key, views in sections.items()
        for i, view in enumerate(views)
        for k, panel in enumerate(view.panels)
    }
    return script_json({"template": TEMPLATE, "figures": figures})


def script_json(data: Any) -> Markup:
    """JSON that is safe in a script element: nothing in it closes the element or opens another."""
    text = json.dumps(_finite(data), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    # unconverted by Plotly, such as an empty array
    if isinstance(value, np.ndarray | np.generic):
        return _finite(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def symbols(text: str) -> Markup:
    """Return text with subscripts of symbols as HTML."""
    return Markup(_SYMBOL.sub(r"\1<sub>\2</sub>", str(escape(text))))
