"""How the command ends: in all but the search for garbage as Python does."""

import re
import sys
from pathlib import Path

from children import PIPE, finished

ROOT = Path(__file__).parents[2]
# A file that only the search for garbage at the end closes.
MINE = """
class Holder:
    pass
holder = Holder()
holder.itself = holder
holder.file = open("mine.txt", "w")
holder.file.write("kept")
"""
LAW = "from ffsm_drake.systems.controllers.laws.tdc import Tdc"


def test_a_file_of_a_users_module_is_written_at_the_end(tmp_path):
    (tmp_path / "mine.py").write_text(MINE + LAW)
    words = ["validate", "postcapture", "--no-rehearsal", "-c", "mine:Tdc"]
    command = [sys.executable, "-m", "ffsm_drake", *words]
    done = finished(command, cwd=tmp_path, stdout=PIPE, stderr=PIPE, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "mine.txt").read_text() == "kept"


def test_the_library_leaves_garbage_collection_alone():
    """Only the command line sets when garbage is collected."""
    sets = re.compile(r"\bgc\.(set_threshold|disable|enable|freeze)\b|from gc import")
    files = [path for path in (ROOT / "ffsm_drake").rglob("*.py") if sets.search(path.read_text())]
    assert [path.name for path in files] == ["__main__.py"]
