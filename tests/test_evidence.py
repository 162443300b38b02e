"""The tables of the evidence pages cover what they are about: every figure of the models has a
source or is called assumed, every claim has a command and a date, and every requirement names tests
that exist, or is a known issue.
"""

import ast
import functools
import importlib.util
import itertools
import json
import re
import shlex
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from children import finished
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.cli import main
from ffsm_drake.scenario import shipped_scenarios

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
URDFS = sorted((ROOT / "models" / "urdf").glob("*.urdf"))
# Keys of a scenario with figures of the spacecraft, its target, sensors and actuators.
FIGURES = (
    "payload.truth",
    "payload.nominal",
    "capture.rate",
    "capture.velocity",
    "capture.compliance",
    "model.flexible",
    "actuation",
    "sensing",
    "disturbance",
)


def loaded(path):
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


tables = loaded(DOCS / "_ext" / "evidence_tables.py")


def is_number(value):
    return isinstance(value, (int, float)) or (isinstance(value, list) and is_number(value[0]))


def test_every_link_with_a_mass_has_one_source():
    assert {path.name for path in URDFS} == set(tables.entries()["masses"])
    for path in URDFS:
        names = tables.links_of(path)
        patterns = tables.entries()["masses"][path.name]
        found = Counter(name for key in patterns for name in tables.matching(key, names))
        assert found == Counter(names.keys()), path.name
        assert all(tables.matching(key, names) for key in patterns), path.name


@pytest.mark.parametrize("path", URDFS, ids=lambda path: path.stem)
def test_masses_and_inertias_are_those_that_drake_reads(path):
    plant = MultibodyPlant(0.0)
    (model,) = Parser(plant).AddModels(str(path))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    links = tables.links_of(path)
    assert len(links) > 0
    for name, link in links.items():
        body = plant.GetBodyByName(name, model)
        spatial = body.CalcSpatialInertiaInBodyFrame(context)
        assert spatial.get_mass() == link.mass
        np.testing.assert_allclose(spatial.get_com(), link.center, rtol=1e-12)
        found = spatial.CalcRotationalInertia().ShiftToCenterOfMass(
            spatial.get_mass(), spatial.get_com()
        )
        moments = [*found.get_moments(), *found.get_products()]
        np.testing.assert_allclose(moments, link.inertia, rtol=1e-9, atol=1e-12 * link.mass)


@pytest.mark.parametrize("scenario", shipped_scenarios())
def test_every_figure_of_a_scenario_has_one_source(scenario):
    values = tables.written(scenario)
    figures = [key for key, value in values.items() if key.startswith(FIGURES) and is_number(value)]
    found = Counter[str]()
    for pattern, (*_, scenarios) in tables.entries()["figures"].items():
        if scenario in scenarios:
            keys = tables.matching(pattern, values)
            assert keys, f"{pattern} is not in {scenario}"
            found.update(keys.keys())
    assert found == Counter(figures)


def test_every_figure_of_a_layout_has_one_source():
    values = tables.layouts()
    found = Counter(
        key for pattern in tables.entries()["thrusters"] for key in tables.matching(pattern, values)
    )
    assert found == Counter(values.keys())


def test_kinds_and_short_names_are_known():
    rows = [*tables.mass_rows(), *tables.setting_rows()]
    assert {row.kind for row in rows} == set(tables.KINDS)
    assert all(row.values and row.source and row.spread for row in rows)
    entries = tables.entries()
    assert set(entries["defaults"]) == {
        key
        for key, (*_, scenario) in entries["defaults"].items()
        if key == "actuation.drives" or tables.matching(key, tables.resolved(scenario))
    }
    text = (DOCS / "validation" / "parameters.yaml").read_text().split("\nmasses:")[1]
    for name in [*entries["sources"], *entries["spreads"]]:
        assert re.search(rf", {name}[],]", text), f"{name} is not used"


def test_a_figure_without_a_source_is_assumed():
    for row in [*tables.mass_rows(), *tables.setting_rows()]:
        assert row.kind == "assumed" or row.source != "none", row


ASSUMED = ROOT / "benchmarks" / "assumed_inputs"
PARTS = ("parameters", "derive")


def test_campaigns_over_arms_scale_what_they_name(tmp_path):
    arms = loaded(ASSUMED / "arms.py")
    for scenario, servicer, _, links, masses, _ in arms.MISSIONS.values():
        assert scenario in shipped_scenarios()
        urdf = ROOT / "models" / "urdf" / f"{servicer}.urdf"
        path = tmp_path / "scaled.urdf"
        path.write_text(arms.scaled(urdf, links, 3.0, masses=masses))
        before, after = tables.links_of(urdf), tables.links_of(path)
        chosen = tables.matching(links, before)
        assert before.keys() == after.keys()
        assert 0 < len(chosen) < len(before)
        for name, link in before.items():
            factor = 3.0 if name in chosen else 1.0
            np.testing.assert_allclose(after[name].inertia, np.multiply(factor, link.inertia))
            assert after[name].mass == (factor if masses else 1.0) * link.mass


def test_the_ranking_finds_what_explains_an_output():
    rank = loaded(ASSUMED / "rank.py")
    generator = np.random.default_rng(3)
    values = pd.DataFrame({name: generator.uniform(-1, 1, 96) for name in ("edge", "bowl", "none")})
    output = (values["edge"] > 0.3) + 3 * values["bowl"] ** 2
    bins = rank.in_bins(values)
    edge, bowl, none = rank.shares(bins, output.to_numpy()[:, None])[:, 0]
    shuffled = np.array([generator.permutation(output) for _ in range(200)]).T
    chance = np.quantile(rank.shares(bins, shuffled).max(axis=0), 0.95)
    assert bowl > edge > chance > none


def test_a_figure_of_the_campaigns_is_varied_in_one():
    specs = [yaml.safe_load(path.read_text()) for path in ASSUMED.glob("*.yaml")]
    names = {name for spec in specs for part in PARTS for name in spec.get(part, ())}
    names |= {re.sub(r"\.\d$", "", name) for name in names}  # the list of an entry
    names |= {name.removeprefix("actuation.thrusters.") for name in names}  # as in a layout
    keys = dict.fromkeys(names)
    rows = [row for row in tables.setting_rows() if "#which-assumed-figures-decide" in row.spread]
    assert rows
    for row in rows:
        assert tables.matching(row.what.strip("`"), keys), row


def test_the_mass_of_a_payload_is_that_of_its_model():
    """Where a scenario repeats figures of a URDF."""
    for scenario, file, name in (
        ("postcapture", "debris", "debris"),
        ("envisat", "envisat", "envisat"),
        ("ets_vii", "ets_vii", "link_6"),
        ("planar_detumble", "planar_target", "target"),
        ("tohoku_arms", "tohoku_target", "debris"),
    ):
        link = tables.links_of(ROOT / "models" / "urdf" / f"{file}.urdf")[name]
        values = tables.written(scenario)
        assert values["payload.truth.mass"] == link.mass
        inertia = [*values["payload.truth.inertia"], 0, 0, 0][:6]
        np.testing.assert_allclose(inertia, link.inertia, rtol=1e-9)


@functools.cache
def functions_in(path):
    return {
        node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)
    }


def test_requirements_name_pages_and_tests_that_exist():
    text = tables.REQUIREMENTS.read_text()
    found = tables.requirements()
    assert len(found) == len(re.findall(r"^R-", text, re.MULTILINE)), "an identifier twice"
    assert 25 <= len(found) <= 50
    for name, requirement in found.items():
        assert requirement.text.endswith("."), name
        assert (DOCS / f"{requirement.page}.md").is_file(), name
        for test in requirement.tests:
            file, _, function = test.partition("::")
            assert function in functions_in(ROOT / file), f"{name}: {test}"


def test_a_requirement_that_is_not_met_is_a_known_issue():
    found = tables.requirements()
    lines = tables.requirement_table().splitlines()[2:]
    for line, (name, requirement) in zip(lines, found.items(), strict=True):
        assert f"[{name}]" in line
        assert ("**not met**" in line) == ("**no test**" in line) == (not requirement.tests)
        assert ("**partly**" in line) == bool(requirement.tests and requirement.exception)
    open_ones = {name for name, (_, _, tests, failing) in found.items() if failing or not tests}
    text = (DOCS / "known_issues.md").read_text()
    assert set(re.findall(r"R-[A-Z]+-\d+", text)) == open_ones


def test_an_assumed_figure_says_how_far_it_was_varied():
    for row in [*tables.mass_rows(), *tables.setting_rows()]:
        assert row.kind != "assumed" or row.spread not in ("none given", "not quantified"), row


@pytest.mark.parametrize("page", ["parameters", "requirements"])
def test_tables_are_on_their_pages(page):
    text = (DOCS / "validation" / f"{page}.md").read_text()
    assert any(mark in text for mark in tables.TABLES)
    filled = tables.with_tables(text)
    assert "<!--" not in filled
    widths = {line.count("|") for line in tables.mass_table().splitlines()}
    assert widths == {6}


PAGES = sorted((DOCS / "validation").glob("*.md"))
SAME = re.compile(r"(the )?same\b")


def test_claims_are_the_rows_of_their_tables():
    head = "| claim | command | date |\n|---|---|---|\n"
    text = head + "| a | `x \\| y` | 1 |\n| b \\| c | `pytest` | 2 |\n\n| a | no claim |\n"
    assert tables.claims(text) == [("a", "`x \\| y`", "1"), ("b \\| c", "`pytest`", "2")]
    assert tables.claims("| claim: how many | date |\n|---|---|\n| a | 2 |") == [("a", "", "2")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_claim_has_a_command_and_a_date(page):
    text = page.read_text()
    assert "not recorded" not in text
    before = ""
    for claim in tables.claims(text):
        assert re.match(r"\d{4}-\d\d-\d\d", claim.date), claim
        assert claim.command, claim
        assert before or not SAME.match(claim.command), claim
        before = claim.command


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_rows_have_the_cells_of_their_table(page):
    width = 0
    for line in page.read_text().splitlines():
        cells = re.split(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", line))
        if not line.startswith("|"):
            width = 0
        else:
            assert width in (0, len(cells)), line
            width = len(cells)


def test_a_full_command_can_be_pasted():
    rows = {
        "`ffsm run paper`": True,
        "the same": True,
        "`A=1 pytest tests -k x`; `time ffsm run paper`": True,
        "`ffsm run paper -c LAW`": False,
        "same": False,
        "the command below": True,
        "`ffsm run paper` with the panels": False,
        "arithmetic": False,
    }
    text = "| claim | command |\n|---|---|\n" + "\n".join(f"| a | {each} |" for each in rows)
    assert tables.full_commands(text) == [*rows.values()]


def test_credibility_counts_claims_and_full_commands():
    texts = [page.read_text() for page in PAGES]
    full = [each for text in texts for each in tables.full_commands(text)]
    said = "of more than 300 rows with a claim, more than nine of ten have a full command"
    assert said in (DOCS / "credibility.md").read_text()
    assert len(full) > 300
    assert sum(full) > 0.9 * len(full)


def test_credibility_says_how_much_is_older_than_its_date():
    dates = [claim.date[:10] for page in PAGES for claim in tables.claims(page.read_text())]
    text = (DOCS / "credibility.md").read_text()
    assert "About four of ten rows have a date before 2026-11-29." in text
    assert 0.35 < sum(date < "2026-11-29" for date in dates) / len(dates) < 0.45


def test_credibility_counts_assumed_figures():
    rows = [*tables.mass_rows(), *tables.setting_rows()]
    assumed = sum(row.kind == "assumed" for row in rows)
    assert f"{assumed} of {len(rows)} rows are assumed" in (DOCS / "credibility.md").read_text()


def commands_in(text):
    """The commands between backquotes, as words without variables."""
    for line in text.splitlines():
        for found in re.findall(r"`((?:[A-Z_]+=\S+ )*(?:pytest|python|ffsm) [^`]+)`", line):
            words = shlex.split(found)
            yield list(itertools.dropwhile(lambda word: re.match(r"[A-Z_]+=", word), words))


def without_marks(words):
    """A command that runs all tests of its files and -k, but exhaustive ones."""
    before, after = words, []
    if "-m" in words:
        at = words.index("-m")
        before, after = words[:at], words[at + 2 :]
    return ["-m", "not exhaustive", *before, *after]


def test_marks_are_replaced():
    assert without_marks(["-m", "slow", "tests", "-k", "x"]) == without_marks(["tests", "-k", "x"])


@pytest.mark.long
def test_commands_of_claims_select_tests(tmp_path):
    """Each command of a claim selects a test, and its mark leaves none out: a test that gets
    another mark, because it takes longer, stays in the command of its row.
    """
    commands = [
        (page.stem, words)
        for page in PAGES
        for claim in tables.claims(page.read_text())
        for program, *words in commands_in(claim.command)
        if program == "pytest"
    ]
    assert len(commands) > 150
    asked = [words for _, words in commands]
    asked += [without_marks(words) for words in asked]
    file = tmp_path / "commands.json"
    file.write_text(json.dumps([*asked, ["-k", "no_such_test"]]))
    done = finished(
        [sys.executable, "tests/selected_tests.py", str(file)], cwd=ROOT, longest=580.0, check=True
    )
    *numbers, none = json.loads(done.stdout)
    assert none == 0
    for command, number, whole in zip(commands, numbers, numbers[len(commands) :], strict=False):
        assert number > 0, command
        assert number >= whole or "exhaustive" in command[1], command


@functools.cache
def names_in(path):
    """The names of the tests below a path, and of what draws their cases."""
    files = [path] if path.is_file() else sorted(path.rglob("*.py"))
    texts = [file.name + file.read_text() for file in files]
    if path.is_file():
        texts += [found.read_text() for found in path.parent.glob("*drawn*.py")]
    return "\n".join(texts)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_of_claims_name_what_exists(page):
    """Test files and the words that choose among their tests, scripts, and commands of ffsm."""
    for program, *words in commands_in(page.read_text()):
        text = " ".join([program, *words])
        if program == "ffsm":
            assert words[0] in main.list_commands(None), text
        for word in words:
            if word.startswith(("tests/", "benchmarks/", "docs/", "examples/")):
                assert (ROOT / word.partition("::")[0]).exists() or "PATH" in word, text
        paths = [ROOT / word for word in words if word.startswith("tests/") and "::" not in word]
        for key in [words[i + 1] for i, word in enumerate(words) if word == "-k"]:
            for part in re.split(r" or ", key):
                assert any(part in names_in(path) for path in paths), f"{text}: {part}"


FACTOR = re.compile(r"^\| \[([^]]+)\]\(#([\w-]+)\) \| (\d) \| (.+) \|$", re.MULTILINE)


def test_each_factor_of_credibility_links_evidence_and_what_is_missing():
    """The test reads no sentence: an assessor has to judge whether a level is right."""
    text = (DOCS / "credibility.md").read_text()
    factors = FACTOR.findall(text)
    assert len(factors) == 8
    for name, anchor, level, _ in factors:
        assert name.lower().replace(" ", "-").replace("&", "") == anchor
        section = text.split(f"## {name}\n")[1].split("\n## ")[0]
        assert int(level) <= 4
        assert re.search(r"^\| .+\]\((validation|\w+\.md|\.\.)", section, re.MULTILINE), name
        assert f"Missing for level {int(level) + 1}" in section, name


class Strict(yaml.SafeLoader):
    """A reader that refuses a key given twice, of which the last one would count."""

    def construct_mapping(self, node, deep=False):
        keys = [key.value for key, _ in node.value]
        assert len(keys) == len(set(keys)), keys
        return super().construct_mapping(node, deep)


@pytest.mark.parametrize("path", [tables.PARAMETERS, tables.REQUIREMENTS], ids=lambda p: p.stem)
def test_no_key_is_given_twice(path):
    assert yaml.load(path.read_text(), Strict)
