"""Compiled code is kept in a folder of the tests."""

import pytest

from ffsm_drake.spacecraft.dynamics import dynamics_names


@pytest.fixture(scope="session", autouse=True)
def _kept_code(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def pytest_collection_modifyitems(items):
    """Without llvmlite, or the plug-in's entry point, these tests have nothing to test."""
    reason = ""
    try:
        import llvmlite  # noqa: F401
    except ImportError:
        reason = "needs llvmlite: pip install 'ffsm-drake[generated]'"
    if not reason and "generated" not in dynamics_names():
        reason = "needs the entry point of the dynamics: pip install -e . again"
    for item in items:
        if reason and "plugins/generated" in item.path.as_posix():
            item.add_marker(pytest.mark.skip(reason=reason))
