"""Objects of installed packages are found by their entry points, and loaded when asked for."""

import pytest
from entry_points import installed

from ffsm_drake import BlockError, FfsmError
from ffsm_drake.common.registrations import Registry

THINGS = Registry("things")


@pytest.fixture
def things(tmp_path, monkeypatch):
    modules = {
        "good_thing": "THING = 3\n",
        "bad_thing": "raise ValueError('not today')\n",
        "needy_thing": "import a_package_that_nobody_has\n",
    }
    names = {name: f"{name}:THING" for name in ("good_thing", "bad_thing", "needy_thing")}
    yield from installed(
        tmp_path,
        monkeypatch,
        modules,
        {"ffsm_drake.things": {**names, "gone_thing": "gone_thing:THING"}},
    )


@pytest.mark.smoke
@pytest.mark.usefixtures("things")
def test_an_offered_object_is_loaded():
    assert list(THINGS.offers()) == ["bad_thing", "gone_thing", "good_thing", "needy_thing"]
    assert THINGS.load("good_thing", "here") == 3


@pytest.mark.usefixtures("things")
def test_what_nobody_offers_is_named():
    with pytest.raises(FfsmError, match=r"^here: no installed plug-in offers 'god_thing' .*'good_"):
        THINGS.load("god_thing", "here")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("bad_thing", r"ValueError: not today \(in <module>: .*bad_thing.py, line 1\)"),
        ("needy_thing", "No module named 'a_package_that_nobody_has'"),
        ("gone_thing", "No module named 'gone_thing'"),
    ],
)
@pytest.mark.usefixtures("things")
def test_what_cannot_be_loaded_says_why(name, said):
    with pytest.raises(BlockError, match=f"^here: plug-in {name}:THING cannot be loaded: {said}$"):
        THINGS.load(name, "here")
