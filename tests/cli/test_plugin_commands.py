"""Commands of plug-ins: listed, run, and named where they are missing; imported only then."""

import sys

import pytest
from children import finished
from click.testing import CliRunner
from entry_points import installed

from ffsm_drake.cli import main

GOOD = """
import click

@click.command()
@click.argument("word")
def shout(word):
    \"\"\"Say it loud.\"\"\"
    click.echo(word.upper())
"""


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    modules = {"good_plugin": GOOD, "bad_plugin": "1 / 0\n", "odd_plugin": "shout = 3\n"}
    offers = {
        "shout": "good_plugin:shout",
        "broken": "bad_plugin:shout",
        "odd": "odd_plugin:shout",
        "run": "bad_plugin:shout",  # a name of the core stays the core's
    }
    yield from installed(tmp_path, monkeypatch, modules, {"ffsm_drake.commands": offers})


def ffsm(*arguments):
    return CliRunner().invoke(main, arguments)


@pytest.mark.usefixtures("plugins")
def test_a_command_of_a_plugin_is_listed_and_runs():
    listed = ffsm("--help")
    assert listed.exit_code == 0
    assert "Say it loud." in listed.output
    broken = {line.split()[0] for line in listed.output.splitlines() if "cannot be" in line}
    assert broken >= {"broken", "odd"}
    assert not broken & {"shout", "run"}
    assert ffsm("shout", "ho").output == "HO\n"
    assert "Run a scenario" in ffsm("run", "--help").output


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("broken", "bad_plugin:shout cannot be loaded: ZeroDivisionError: division by zero (in"),
        ("odd", "'odd': plug-in offers an object of type int, not a click command"),
    ],
)
@pytest.mark.usefixtures("plugins")
def test_one_line_says_what_is_missing(name, said):
    done = ffsm(name, "--option", "value")
    assert done.exit_code == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert said in done.stderr


@pytest.mark.smoke
def test_other_commands_import_no_plugin():
    for words in (["--version"], ["validate", "--help"]):
        code = (
            f"import sys, ffsm_drake.cli as c; c.main({words}, standalone_mode=False); "
            "print([name for name in sys.modules if name.startswith('ffsm_drake.plugins')])"
        )
        done = finished([sys.executable, "-c", code], check=True)
        assert done.stdout.splitlines()[-1] == "[]"
