"""Compiled code is kept in a folder of the tests; without llvmlite they are skipped."""

from importlib.util import find_spec

import pytest

from ffsm_drake.common.plugins import ENGINES, offered

COMPILED = "compiled"


@pytest.fixture(autouse=True)
def _kept_code(request, tmp_path_factory, monkeypatch):
    if request.path.parent.name == COMPILED:
        folder = tmp_path_factory.getbasetemp() / "kept_code"
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder))


def pytest_collection_modifyitems(items):
    """Without llvmlite, or the plug-in's entry point, these tests have nothing to test."""
    for item in items:
        if item.path.parent.name != COMPILED:
            continue
        if not find_spec("llvmlite"):
            reason = "needs llvmlite: pip install 'ffsm-drake[compiled]'"
            item.add_marker(pytest.mark.skip(reason=reason))
        elif COMPILED not in offered(ENGINES):
            reason = "needs the entry point of the engine: pip install -e . again"
            item.add_marker(pytest.mark.skip(reason=reason))
