"""Where commands run: locales other than UTF-8, few open files."""

import os
import re
import sys

import pytest
from children import finished

FEW = """import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, ({0}, {0}))
sys.argv = ["ffsm", "scenarios"]
from ffsm_drake.__main__ import main
main()
"""


def ended(*words, **env):
    """A Python process that has ended, in another environment."""
    return finished([sys.executable, *words], env={**os.environ, **env}, longest=100.0, text=False)


@pytest.mark.parametrize(
    "env",
    [
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "latin-1"},
        *(
            pytest.param({"LC_ALL": name, "PYTHONUTF8": "0"}, marks=pytest.mark.long)
            for name in ("C", "POSIX", "en_US.ISO-8859-1", "de_DE@euro")
        ),
        pytest.param({"LC_ALL": "no_such_locale", "PYTHONUTF8": "0"}, marks=pytest.mark.long),
        pytest.param({"PYTHONIOENCODING": "ascii"}, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_any_locale_will_do(env):
    found = ended("-m", "ffsm_drake", "validate", "planar_detumble", "--no-rehearsal", **env)
    assert found.returncode == 0, found.stderr
    assert b"planar_detumble: valid; " in found.stdout
    lines = found.stderr.splitlines()
    assert all(re.match(rb" *\d+ s: ", line) for line in lines), lines  # on a busy machine


@pytest.mark.parametrize("number", [4, 5, pytest.param(6, marks=pytest.mark.slow)])
def test_few_open_files_are_enough_or_one_line(number):
    """Not among them: a Python whose own start needs more, as by a .pth file."""
    found = ended("-S", "-c", f"import sys; sys.path[:] = {sys.path!r}\n" + FEW.format(number))
    if number < 6:
        assert found.returncode == 2, found.stderr
        assert found.stderr.startswith(b"error: too few files may be open")
        assert len(found.stderr.splitlines()) == 1, found.stderr
    else:
        assert found.returncode == 0, found.stderr
        assert b"postcapture" in found.stdout
