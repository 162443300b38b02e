"""Self-contained HTML pages: one Jinja environment, one stylesheet, and Plotly figures embedded as
data.
"""

import functools
import json
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from ffsm_drake.show.panels import TEMPLATE, View
from ffsm_drake.show.style import PAGE, label_of

_SYMBOL = re.compile(r"(?<![\w.])(K|G|s|q|τ|β|beta|N\*)_(si|s|d\d|[iDPd])\b")


def render(template: str, content: Mapping[str, Any], *, package: str = "ffsm_drake.show") -> str:
    """A page as text; nothing that it needs is outside it.

    ``template`` is a file in the package's folder ``templates`` (or the show room's), ``content``
    what it names; ``plots``, from ``embedded``, brings plotly.js with it.
    """
    return _environment(package).get_template(template).render(content)


@functools.cache
def _environment(package: str) -> Environment:
    """Where a package's templates come from; it compiles each of them once."""
    folders = dict.fromkeys((package, "ffsm_drake.show"))
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(name, "templates") for name in folders]),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"symbols": symbols, "label": label_of}
    environment.globals |= {"palette": PAGE, "plotly_script": plotly_script}
    return environment


def plotly_script() -> Markup:
    """plotly.js itself, for a script element."""
    from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]

    return Markup(get_plotlyjs().replace("</script", "<\\/script"))


def embedded(sections: Mapping[str, Iterable[View]]) -> Markup:
    """The figures of a page's sections as JSON; the page names each by section, view and place
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
    """JSON that a script element can hold: nothing in it can close the element or open another."""
    text = json.dumps(_finite(data), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    # what Plotly has left as it is, such as an array without elements
    if isinstance(value, np.ndarray | np.generic):
        return _finite(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def symbols(text: str) -> Markup:
    """Text with its symbols' subscripts as HTML."""
    return Markup(_SYMBOL.sub(r"\1<sub>\2</sub>", str(escape(text))))
