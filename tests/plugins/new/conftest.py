"""Most tests of ``ffsm new`` read models in this process; test_hostile_models.py reads them as
commands do.
"""

import pytest

from ffsm_drake.plugins.new.urdf import formats
from ffsm_drake.plugins.new.urdf.formats.converting import convert


@pytest.fixture(autouse=True)
def _read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "answer", lambda task, **question: convert(**question))
