"""How the command ends: quickly, without freeing every object, and in all else as Python does."""

import os
import re
import sys
from pathlib import Path

import pytest
from children import finished

ROOT = Path(__file__).parents[2]
# The script ``ffsm`` with an option ``--end``, and with what has to do something at the end.
SCRIPT = """
import atexit, ctypes, gc, json, logging, logging.handlers, multiprocessing, sys, threading, time
import click
{first}
from ffsm_drake import cli
from ffsm_drake.__main__ import main

class Freed:
    def __del__(self, write=sys.__stderr__.write if sys.__stderr__ else id):
        write("freed\\n")

def last(started):
    started.set()
    while True:  # a signal just before a long sleep would wait for its end
        time.sleep(0.05)

def end(context, option, code):
    if code is None:
        return
    print("collects after", gc.get_threshold()[0])
    print("a line without its end", end="")
    if sys.stdout:
        ctypes.CDLL(None).printf(b"C has buffers too\\n")
    sys.exit(json.loads(code))

if __name__ == "__main__":
    option = click.Option(["--end"], callback=end, is_eager=True, expose_value=False)
    cli.main.params.append(option)
    freed = Freed()
    log = logging.getLogger("at the end")
    target = logging.FileHandler("log.txt")
    log.addHandler(logging.handlers.MemoryHandler(100, target=target))
    log.error("held until the end")
    context = multiprocessing.get_context("fork")
    if {children}:
        started = context.Event()
        context.Process(target=last, args=(started,), daemon=True).start()  # to be ended
        started.wait()  # a signal that comes while Python forks is lost
        context.Process(target=time.sleep, args=(0.2,)).start()  # to be awaited
    atexit.register(print, "; handler", [child.exitcode for child in
        multiprocessing.active_children()])
    atexit.register(lambda: 1 / 0)
    threading._register_atexit(print, "; threads over")
    sys.exit(main())
"""


def ended(folder: Path, name: str, *words: str, streams="", first="", children=False):
    """Exit code, standard output, standard error of the script under a name, and whether objects
    were freed.
    """
    folder.mkdir(exist_ok=True)
    script = folder / name
    script.write_text(SCRIPT.format(first=first, children=children))
    # the shell closes or redirects streams
    command = ["sh", "-c", f'exec "$@" {streams}', "sh", sys.executable, str(script), *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop("PYTHONUNBUFFERED", None)  # what is printed is to be in buffers at the end
    done = finished(command, cwd=folder, env=environment, longest=60.0)
    said = re.sub(r"0x[0-9a-f]+", "", done.stderr.replace(str(script), "SCRIPT"))
    lines = said.splitlines()
    left = [line for line in lines if line != "freed"]
    return (done.returncode, done.stdout, left), left != lines


@pytest.mark.parametrize(
    ("code", "streams", "quick"),
    [
        ("0", "", True),
        ("null", "2>/dev/full", True),
        ("3", "", True),
        ("143", "", True),
        ("0", "2>&-", True),
        ("3", ">&-", True),
        ("2", ">/dev/full", False),
        ('"text"', "", False),
        ("-1", "", False),
        ("1000000000000", "", False),
    ],
)
def test_the_command_ends_as_python_does(code, streams, quick, tmp_path):
    """Exit code, streams and handlers are those of the same script under another name."""
    settings = {"streams": streams, "children": code == "3"}
    found, freed = ended(tmp_path / "a", "ffsm", "--end", code, **settings)
    expected, always = ended(tmp_path / "b", "other", "--end", code, **settings)
    assert found == expected
    assert (tmp_path / "a" / "log.txt").read_text() == "held until the end\n"
    if "2>" not in streams:
        assert always
        assert freed != quick
        assert "ZeroDivisionError" in "".join(found[2])  # of a handler
    if ">&-" not in streams and "/dev/full" not in streams:
        assert "collects after 10000" in found[1]
        assert "C has buffers too" in found[1]
        assert "its end" in found[1]
        assert "; threads over\n; handler" in found[1]


@pytest.mark.parametrize(
    "first",
    ["import mine", "sys.settrace(lambda *each: None)", "sys.setprofile(lambda *each: None)"],
)
def test_python_ends_what_may_need_it(first, tmp_path):
    """User-supplied code with an open file, a debugger, a profiler."""
    (tmp_path / "mine.py").write_text("file = open('mine.txt', 'w')\nfile.write('kept')\n")
    (code, _, _), freed = ended(tmp_path, "ffsm", "--end", "3", first=first)
    assert (code, freed) == (3, True)
    assert first != "import mine" or (tmp_path / "mine.txt").read_text() == "kept"


def test_the_library_leaves_garbage_collection_alone():
    """Only the command line sets when garbage is collected."""
    sets = re.compile(r"\bgc\.(set_threshold|disable|enable|freeze)\b|from gc import")
    files = [path for path in (ROOT / "ffsm_drake").rglob("*.py") if sets.search(path.read_text())]
    assert [path.name for path in files] == ["__main__.py"]
