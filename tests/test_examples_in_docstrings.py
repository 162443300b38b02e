"""The example in the docstring of each public name runs, and prints what it says."""

import doctest

import pytest

import ffsm_drake
from ffsm_drake.common.plugins import VERBS, offered

SLOW = {"design", "run_campaign"}
NAMES = [*ffsm_drake.__all__, *offered(VERBS)]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in NAMES]
)
def test_the_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = getattr(ffsm_drake, name).__doc__
    found = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert found.examples, "needs an example"
    said = []
    doctest.DocTestRunner(verbose=False).run(found, out=said.append)
    assert not said, "".join(said)
