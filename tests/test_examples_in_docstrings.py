"""The example in the docstring of each public name runs, and prints what it says."""

import doctest
import re
from pathlib import Path

import pytest
from entry_points import needs

import ffsm_drake
from ffsm_drake.common.registrations import VERBS

SLOW = {"design", "run_campaign"}
NEEDS = {"write_outputs": [needs("report")]}
NAMES = [*ffsm_drake.__all__, *VERBS.offers()]
SEEN = Path(ffsm_drake.__file__).with_suffix(".pyi").read_text()  # by type checkers


@needs("analysis")
@needs("campaign")
@needs("design")
@needs("exports")
def test_type_checkers_see_each_name():
    assert sorted(re.findall(r'^    "(\w+)",$', SEEN, re.MULTILINE)) == sorted(NAMES)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.long] * (name in SLOW) + NEEDS.get(name, []))
        for name in NAMES
    ],
)
def test_the_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = getattr(ffsm_drake, name).__doc__
    found = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert found.examples, "needs an example"
    said = []
    doctest.DocTestRunner(verbose=False).run(found, out=said.append)
    assert not said, "".join(said)
