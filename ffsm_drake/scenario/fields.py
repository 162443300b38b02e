"""The kinds of settings that the sections of a scenario share."""

import re
from collections.abc import Collection, Iterable
from typing import Any

from ffsm_drake.common.errors import did_you_mean
from ffsm_drake.common.settings import Problems, setting

PerCoordinate = dict[str, float]
_ADDRESS = r"[^\W\d]\w*(\.\w+)*:[^\W\d]\w*(\.\w+)*"  # module:attribute
_NAME = re.compile(rf"[^\W\d]\w*|{_ADDRESS}")
POLICY = "policy:"  # begins the controller of an ONNX file
_POLICY = re.compile(rf"{POLICY}(?P<file>.+?)(@(?P<law>[^\W\d]\w*|{_ADDRESS}))?")
ORIGIN, X_AXIS = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]
ZERO = {"all": 0.0}


def unitless(default: Any, meaning: str, **limits: Any) -> Any:
    """Return a setting that has no unit: a share, a text, a list of names."""
    return setting(default, "", meaning, **limits)


def choice_of(default: str | None, meaning: str, *one_of: str) -> Any:
    """Return a setting that is one of several words."""
    return unitless(default, meaning, one_of=one_of)


def in_samples(default: Any, meaning: str, least: int = 0) -> Any:
    """Return a setting that is a number of control samples."""
    return setting(default, "control samples", meaning, least=least, most=1000)


def vector_in(default: list[float] | None, unit: str, meaning: str, **limits: Any) -> Any:
    """Return a setting of three numbers."""
    return setting(default, unit, meaning, size=(3, 3), **limits)


def name_problems(name: str, key: str) -> Problems:
    """Problems with the name of a system."""
    if not _NAME.fullmatch(name):
        yield key, f"'{name}' must be a name or module:attribute"


def policy_parts(controller: str) -> tuple[str, str] | None:
    """Return the file of ``policy:FILE@LAW`` and the law that the policy changes (empty if the file
    names it); None for any other controller.
    """
    found = _POLICY.fullmatch(controller)
    return found and (found["file"], found["law"] or "")


def controller_problems(name: str, key: str) -> Problems:
    """Problems with the name of a controller."""
    if not name.startswith(POLICY):
        yield from name_problems(name, key)
    elif policy_parts(name) is None or not name.isprintable():
        yield key, f"'{name}' must be policy:FILE, such as policy:sub/reach.onnx"


def identifier_problems(key: str, names: Iterable[str], whose: str) -> Problems:
    """Problems with user-supplied names."""
    for name in names:
        if not name.isidentifier():
            yield f"{key}.{name}", f"{whose} name must be letters, digits and underscores"


def sample_problems(duration: float, sample_time: float, key: str) -> Problems:
    """A problem with a duration that is not a whole number of control samples, s."""
    samples = duration / sample_time
    if samples < 0.5 or abs(samples - round(samples)) >= 1e-6:
        whole = f"must be a whole number of control samples of {sample_time:g} s"
        near = (round(samples) or 1) * sample_time
        yield key, f"{whole}, not {duration:g} s; the nearest is {near:.6g} s"


def undriven_problems(name: str, key: str, undriven: Collection[str]) -> Problems:
    """Problems with the name of an undriven base coordinate."""
    if name not in undriven:
        close = did_you_mean(name, undriven)
        choice = f"choose one of {', '.join(undriven)}{close}" if undriven else "leave it out"
        yield key, f"'{name}' is no undriven base coordinate (actuation.driven); {choice}"
