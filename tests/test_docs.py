"""The documentation speaks of this package: its commands exist, its examples run, its reference is complete.

That the site builds, with all links inside it, is ``sphinx-build -W``'s to say.
"""

import importlib.util
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from ffsm_drake.cli import main
from ffsm_drake.scenario import (
    Scenario,
    load_scenario,
    scenario_from_dict,
    scenario_from_yaml,
    scenario_to_dict,
    shipped_scenarios,
)

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
NOT_RUN = "<!-- not run -->"  # on the line before a block


def blocks(page: Path, language: str) -> list[str]:
    found = re.findall(rf"(?:^([^\n]*)\n)?^```{language}\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return [text for before, text in found if before.strip() != NOT_RUN]


def shell_commands() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every simple command of the sh blocks, with shell variables replaced by 1."""
    for page in PAGES:
        for block in blocks(page, "sh"):
            for line in re.sub(r"\\\n", " ", block).splitlines():
                lexer = shlex.shlex(re.sub(r"\$\w+", "1", line), posix=True, punctuation_chars=";&|")
                lexer.whitespace_split = True
                words: list[str] = []
                for word in [*lexer, ";"]:
                    if set(word) <= set(";&|"):
                        if words:
                            yield page.name, tuple(words)
                        words = []
                    elif word != "do" or words:
                        words.append(word)


def module_at(path: Path) -> ModuleType:
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def check_overrides(scenario: str, overrides: list[str]) -> None:
    """Shipped scenarios take them; of files that only a page mentions, the schema does."""
    if scenario in shipped_scenarios():
        load_scenario(scenario, overrides)
    else:
        assert scenario.endswith(".yaml"), scenario
        scenario_from_dict({}, overrides)


COMMANDS = sorted(set(shell_commands()))


def test_commands_are_found():
    """The reader of the pages reads: otherwise the tests below would check nothing."""
    assert sum(words[0] == "ffsm" for _, words in COMMANDS) > 10
    assert sum(words[:2] == ("python", "examples/postcapture.py") for _, words in COMMANDS) > 10
    assert sum(words[:2] == ("python", "-c") for _, words in COMMANDS) > 0


@pytest.mark.parametrize(("page", "words"), [pytest.param(*c, id=f"{c[0]}: {' '.join(c[1])[:60]}") for c in COMMANDS])
def test_commands_exist_with_their_options(page, words, capsys):
    if words[0] == "ffsm":
        assert words[1] in main.commands, f"{page}: no command 'ffsm {words[1]}'"
        command = main.commands[words[1]]
        parameters = command.make_context(
            words[1], list(words[2:]), parent=main.make_context("ffsm", [words[1]])
        ).params
        if "overrides" in parameters:
            check_overrides(parameters["scenario"], list(parameters["overrides"]))
    elif words[0] == "python" and words[1].startswith("examples/"):
        path = ROOT / words[1]
        assert path.is_file(), f"{page}: {words[1]} does not exist"
        options = module_at(path).parse_arguments(words[2:])
        check_overrides(getattr(options, "scenario", "postcapture"), getattr(options, "set", []))
    elif words[:2] == ("python", "-c"):
        exec(compile(words[2], page, "exec"), {})
        assert capsys.readouterr().out.strip()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name)
def test_python_examples_run(page, tmp_path, monkeypatch):
    """All python blocks of a page, one after another in one namespace."""
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": page.stem}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), namespace)


@pytest.mark.parametrize(
    ("page", "text"),
    [(page.name, text) for page in PAGES for text in blocks(page, "yaml") if "directives:" not in text],
)
def test_scenario_fragments_are_valid(page, text):
    assert scenario_to_dict(scenario_from_yaml(text)) != scenario_to_dict(Scenario()), page


def test_every_scenario_key_is_in_the_reference_with_a_meaning():
    reference = module_at(DOCS / "_ext" / "scenario_reference.py")
    assert reference.MARKER in (DOCS / "scenario.md").read_text()
    documented, path = set(), ""
    for line in reference.markdown().splitlines():
        if line.startswith("## "):
            path = "" if line == "## Top level" else line.removeprefix("## ").strip("`") + "."
        elif line.startswith("| `"):
            key, *_, meaning = (cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
            assert meaning, f"{path}{key}: write its meaning beside the field in scenario.py"
            documented.add(path + key.strip("`"))

    def keys(value, place=""):
        if isinstance(value, dict) and place.removesuffix(".") not in documented:
            for name, item in value.items():
                yield from keys(item, f"{place}{name}.")
        else:
            yield place.removesuffix(".")

    assert set(keys(scenario_to_dict(Scenario()))) <= documented
    assert "disturbance.harmonics.COORDINATE.phase" in documented


@pytest.mark.parametrize(
    ("key", "unit"),
    [("payload.truth.inertia", "kg m²"), ("controllers.tdc.k_p", "1/s²"), ("initial_posture.base_rpy", "rad")],
)
def test_units_are_read_from_the_comments(key, unit):
    text = module_at(DOCS / "_ext" / "scenario_reference.py").markdown()
    place, _, name = key.rpartition(".")
    section = text.split(f"## `{place}`\n")[1].split("\n## ")[0]
    (row,) = [line for line in section.splitlines() if line.startswith(f"| `{name}` ")]
    assert row.split("|")[4].strip() == unit


def test_the_tutorial_is_stored_without_outputs():
    notebook = json.loads((DOCS / "tutorial.ipynb").read_text())
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 5
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"  # ipykernel's own, in any environment
