"""YAML text in few lines: a value is in one line, in some lines of flow style, or key by key."""

import re
import textwrap
from collections.abc import Mapping
from typing import Any

from ffsm_drake.scenario import write_yaml

WIDTH = 126  # characters of a line
_INDENT, _SHORT = "  ", 360  # characters of nested values that are not written key by key
_TOGETHER = r"\[[^\[\]]*\]|\{[^{}]{0,60}\}|: "  # no line ends in these


def flow_text(key: str, value: Any, indent: str = "") -> str:
    """Return the lines of a key and its value, which ``read_yaml`` reads back unchanged."""
    text, inner = _flow(value), indent + _INDENT
    line = f"{indent}{key}: {text}\n"
    if len(line) <= WIDTH or not isinstance(value, Mapping) or not value:
        return line
    if len(text) > _SHORT and any(isinstance(each, Mapping) for each in value.values()):
        children = (flow_text(_flow(name), each, inner) for name, each in value.items())
        return f"{indent}{key}:\n{''.join(children)}"
    joined = re.sub(_TOGETHER, lambda found: found[0].replace(" ", "\0"), text)
    width = WIDTH - len(inner) - 1
    lines = textwrap.wrap(joined, width, break_long_words=False, break_on_hyphens=False)
    wrapped = "".join(f"{inner}{' ' * (k > 0)}{each}\n" for k, each in enumerate(lines))
    return f"{indent}{key}:\n{wrapped}".replace("\0", " ")


def _flow(value: Any) -> str:
    text = write_yaml(value, allow_unicode=True, width=float("inf"), default_flow_style=True)
    return text.removesuffix("\n").removesuffix("\n...")
