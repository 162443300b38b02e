"""What a record keeps of a part beside its variables, so that a report needs no part."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from ffsm_drake.common.errors import BlockError
from ffsm_drake.systems.parts.metrics import Figure
from ffsm_drake.systems.parts.placed import PlacedPart
from ffsm_drake.systems.parts.signals import Signal


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drawing:
    """How the report draws a variable of the record."""

    signal: str
    heading: str
    chart: str
    title: str  # title of a timeline's panel
    panels: Mapping[str, str]  # component -> unit; of a variable without components its title


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartRecord:
    """Data of a part in a record, beside its variables: the report needs no part."""

    title: str
    section: str  # section of the report
    about: str  # text of that section; "": the sentences of its parts
    sentence: str
    table: tuple[tuple[str | float | None, ...], ...]  # None: not a finite number
    figures: tuple[Figure, ...]
    drawings: tuple[Drawing, ...]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "PartRecord":
        """Build from ``dataclasses.asdict``, through JSON. Raises TypeError for other data."""
        made = {
            "table": tuple(map(tuple, data["table"])),
            "figures": tuple(Figure(**each) for each in data["figures"]),
            "drawings": tuple(Drawing(**each) for each in data["drawings"]),
        }
        return cls(**{**data, **made})


def recorded(placed: PlacedPart, figures: Sequence[Figure]) -> PartRecord:
    """Return the data of a part for the record of a run, with its figures."""
    part, sentence = placed.part, placed.part.sentence(figures)
    table = tuple(map(tuple, part.table(figures)))
    place = f"blocks.{placed.name} '{type(part).__name__}'"
    if not isinstance(sentence, str | None):
        raise BlockError(f"{place}: sentence must be text or None, not {type(sentence).__name__}")
    for entry in itertools.chain(*table):
        if not isinstance(entry, str | int | float):
            raise BlockError(f"{place}: table must hold texts and numbers, not {entry!r:.40}")
    return PartRecord(
        title=placed.title,
        section=part.section,
        about=part.about,
        sentence=_listed(placed.title, figures) if sentence is None else sentence,
        table=table,
        figures=tuple(figures),
        drawings=tuple(
            _drawing(signal, placed.title) for signal in placed.signals if signal.heading != ""
        ),
    )


def _listed(title: str, figures: Sequence[Figure]) -> str:
    """Return the figures with a row, in one line."""
    texts = []
    for figure in figures:
        name = f"{figure.label[:1].lower()}{figure.label[1:]}"
        values = figure.value if isinstance(figure.value, Mapping) else {"": None}
        for each in values if figure.label else ():
            text = f"{figure.text(each)} {figure.shown_unit}".rstrip()
            texts.append(" ".join(filter(None, (name, each, text))))
    return f"{title}: {', '.join(texts)}" if texts else ""


def _drawing(signal: Signal, title: str) -> Drawing:
    """Return the drawing of a signal in the report, for a part of that title."""
    panels = signal.panels
    if panels is None:
        titles = signal.components or (signal.panel or signal.name,)
        panels = dict.fromkeys(titles, "" if signal.unit == "1" else signal.unit)
    heading = signal.heading
    if heading is None:
        heading = f"{title}: {signal.name.replace('_', ' ')}"
    return Drawing(
        signal=signal.name,
        heading=heading,
        chart=signal.chart,
        title=signal.panel or heading,
        panels=dict(panels),
    )
