"""Compiled code is kept in a folder of the tests; without llvmlite they are skipped."""

from importlib.util import find_spec

import pytest

from ffsm_drake.spacecraft.dynamics import dynamics_names

COMPILED = ("compiled", "generated")  # plug-ins, and the dynamics that they bring


@pytest.fixture(autouse=True)
def _kept_code(request, tmp_path_factory, monkeypatch):
    if request.path.parent.name in COMPILED:
        folder = tmp_path_factory.getbasetemp() / "kept_code"
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder))


def pytest_collection_modifyitems(items):
    """Without llvmlite, or the plug-in's entry point, these tests have nothing to test."""
    for item in items:
        name = item.path.parent.name
        if name not in COMPILED:
            continue
        if not find_spec("llvmlite"):
            reason = "needs llvmlite: pip install 'ffsm-drake[generated]'"
            item.add_marker(pytest.mark.skip(reason=reason))
        elif name not in dynamics_names():
            reason = "needs the entry point of the dynamics: pip install -e . again"
            item.add_marker(pytest.mark.skip(reason=reason))
