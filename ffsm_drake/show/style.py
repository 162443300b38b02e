"""Style of runs, groups and pages: a palette, and each controller's name, colour and line."""

import dataclasses
import itertools
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import differing_keys, flatten, scenario_to_dict
from ffsm_drake.systems.registry import block_names, find_factory

# Okabe and Ito's palette: distinct for colour-blind readers and, with the line styles, in grey.
VERMILION, BLUE, GREEN, PURPLE = "#D55E00", "#0072B2", "#009E73", "#CC79A7"
SKY, ORANGE, GREY, BLACK = "#56B4E9", "#E69F00", "#7A7A7A", "#000000"
SERIES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)  # coordinates of one panel
GRID = "#DDDDDD"
UNSTABLE = "#F4D9CC"  # regions where a loop is unstable
NEUTRAL = "#707780"  # text and reference lines, legible on light and dark pages

# Colours of the pages, light and dark.
PAGE = {
    "ink": ("#1b1f24", "#e7e9ec"),
    "soft": ("#5b636e", "#a3abb6"),
    "line": ("#dfe2e7", "#30363e"),
    "page": ("#f6f7f8", "#111417"),
    "card": ("#ffffff", "#1a1e23"),
    "accent": ("#0b5a8f", "#6db3e8"),
    "good": ("#1a7a4c", "#5cc792"),
    "warn": ("#96610a", "#e0ac50"),
    "bad": ("#b3371c", "#f0836a"),
    "mute": ("#5b636e", "#a3abb6"),
}
GOOD, BAD, MUTE = (PAGE[name][0] for name in ("good", "bad", "mute"))

_MATPLOTLIB_DASHES: dict[str, Any] = {
    "solid": "-",
    "dash": "--",
    "dashdot": "-.",
    "dot": ":",
    "longdash": (0, (5, 1)),
    "longdashdot": (0, (3, 1, 1, 1, 1, 1)),
}


@dataclasses.dataclass(frozen=True)
class Style:
    """A colour and a line style (Plotly's name)."""

    color: str
    dash: str = "solid"

    @property
    def matplotlib(self) -> dict[str, Any]:
        """Keywords for Matplotlib's ``plot``."""
        return {"color": self.color, "linestyle": _MATPLOTLIB_DASHES[self.dash]}

    @property
    def css(self) -> str:
        """The nearest CSS border style."""
        return {"solid": "solid", "dot": "dotted"}.get(self.dash, "dashed")


GROUP_TITLES = {
    "base_rotation": "Base attitude",
    "base_position": "Base position",
    "joints": "Joints",
}
GROUP_STYLES = {
    "base_rotation": Style(BLUE),
    "base_position": Style(VERMILION, "longdash"),
    "joints": Style(GREEN),
}
EFFORT_UNITS = {"rad": "N m", "m": "N"}  # unit of a coordinate -> unit of its force or torque

_CONTROLLERS = {
    "tde_aismc": Style(VERMILION),
    "aismc": Style(BLUE, "dash"),
    "asmc": Style(GREEN, "dashdot"),
    "tdc": Style(GREY, "dot"),
    "computed_torque": Style(ORANGE, "longdash"),
    "tvlqr": Style("#332288", "dash"),
    "torque_against_momentum": Style("#999933", "dashdot"),
    "pd_plus": Style(SKY, "longdashdot"),
}
# For other controllers, and for runs whose controller's style is taken.
_SPARE = (
    Style(PURPLE),
    Style("#8C6BB1", "dash"),
    Style("#B8A800", "dashdot"),
    Style("#8C510A", "longdash"),
    Style("#117733", "dot"),
    Style("#882255", "longdashdot"),
)


def label_of(controller: str) -> str:
    """Return a controller's display name: the ``label`` of its class, or its name; the class for
    ``module:Class``.
    """
    if controller in block_names("controller"):
        with suppress(FfsmError, TypeError):  # one that cannot be imported keeps its name
            return vars(find_factory("controller", controller)).get("label", controller)
    return controller.rpartition(":")[2]


def styles_of(controllers: Sequence[str]) -> list[Style]:
    """Return a style for each controller of a figure, all different while spare ones last; dashes
    separate runs, and a single one is solid.
    """
    styles: list[Style] = []
    spares = itertools.cycle(_SPARE)
    for name in controllers:
        own = _CONTROLLERS.get(name)
        styles.append(next(spares) if own is None or own in styles else own)
    return styles if len(styles) > 1 else [Style(style.color) for style in styles]


def labels_of(records: Sequence[RunRecord]) -> list[str]:
    """Return a name for each run: its controller's, with the distinguishing settings if it
    repeats.
    """
    labels = [label_of(record.scenario.controller) for record in records]
    if len(set(labels)) < len(labels):
        flat = [flatten(scenario_to_dict(record.scenario)) for record in records]
        varying = [
            key
            for key in differing_keys(*(record.scenario for record in records))
            if key != "controller"
        ]
        if 1 <= len(varying) <= 2:
            labels = [
                ", ".join([label, *(f"{_short(key)} = {_shown(one.get(key))}" for key in varying)])
                for label, one in zip(labels, flat, strict=True)
            ]
    if len(set(labels)) < len(labels):
        labels = [f"{label}, run {number}" for number, label in enumerate(labels, start=1)]
    return labels


def _short(key: str) -> str:
    """Return the telling part of a dotted key: k_s_max of controllers.tde_aismc.k_s_max.all."""
    return re.sub(r"^controllers\.[^.]*\.", "", key).removesuffix(".all")


def _shown(value: Any) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
