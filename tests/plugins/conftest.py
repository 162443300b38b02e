"""Compiled code is kept in a folder of the tests; without llvmlite they are skipped."""

from importlib.util import find_spec

import pytest

COMPILED = "compiled"


@pytest.fixture(autouse=True)
def _kept_code(request, tmp_path_factory, monkeypatch):
    if request.path.parent.name == COMPILED:
        folder = tmp_path_factory.getbasetemp() / "kept_code"
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder))


def pytest_collection_modifyitems(items):
    """Without llvmlite these tests have nothing to test."""
    for item in items:
        if item.path.parent.name == COMPILED and not find_spec("llvmlite"):
            reason = "needs llvmlite: pip install 'ffsm-drake[compiled]'"
            item.add_marker(pytest.mark.skip(reason=reason))
