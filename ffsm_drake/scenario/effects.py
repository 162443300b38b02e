"""The section ``effects``: imperfections of the true spacecraft, which plug-ins model.

A plug-in brings a dataclass of settings into the group ``effects``. Its file may import settings
(``common.settings``), and nothing else of this package.
"""

import inspect
from dataclasses import make_dataclass
from typing import Any

from ffsm_drake.common.registrations import Registry
from ffsm_drake.common.settings import setting

EFFECTS = Registry[type]("effects")


def _field(name: str) -> tuple[str, Any, Any]:
    kind = EFFECTS.load(name, "effects")
    return name, kind | None, setting(None, "", f"{inspect.getdoc(kind)} null: none")


# an effect that is not given is None
Effects: Any = make_dataclass(
    "Effects",
    [_field(name) for name in EFFECTS.offers() if EFFECTS.find(name)],
    namespace={"UNKNOWN": "no installed plug-in offers this effect"},
)
Effects.__module__ = __name__
