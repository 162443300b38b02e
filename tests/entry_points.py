"""Packages with entry points, as an installer leaves them."""

import re
from pathlib import Path

import pytest

from ffsm_drake.common.registrations import absent_need, offered, own_plugins

# What a command or an error says without a plug-in.
MISSING = re.compile(
    r"no installed plug-in offers|the plug-in '\w+'(, which)? is not installed"
    r"|no (such )?command '[\w ]+|'\w+' is unknown; give module:attribute"
    r"|no module named 'ffsm_drake\.plugins|module 'ffsm_drake' has no attribute"
    r"|'[^']*ffsm_drake/plugins/",
    re.IGNORECASE,
)


def is_there(plugin):
    """False where a plug-in of this package has been deleted."""
    return plugin in own_plugins()


def needs(plugin):
    """A mark of tests that are skipped where a plug-in, or one that it needs, has been deleted."""
    absent = absent_need(plugin)
    return pytest.mark.skipif(absent != "", reason=f"plug-in {absent} is not installed")


def install(folder: Path, modules: dict[str, str], groups: dict[str, dict[str, str]]) -> None:
    """Write a package with its metadata into an empty folder, which belongs on Python's path.

    Args:
      folder: where it goes.
      modules: name -> text.
      groups: entry point group -> name -> ``module:attribute``.
    """
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)
    information = folder / "a_plugin-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: a-plugin\nVersion: 1.0\n")
    lines = [
        f"[{group}]\n" + "".join(f"{name} = {address}\n" for name, address in offers.items())
        for group, offers in groups.items()
    ]
    (information / "entry_points.txt").write_text("\n".join(lines))


def installed(folder, monkeypatch, modules, groups):
    """A fixture's steps: within a test Python finds the package of ``install``."""
    install(folder, modules, groups)
    monkeypatch.syspath_prepend(folder)
    offered.cache_clear()
    yield
    offered.cache_clear()
