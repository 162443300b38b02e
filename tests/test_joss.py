"""The paper for JOSS has its form, its figures come from commands, its references exist; a release
waits for what only a person can fill in.
"""

import re
from pathlib import Path

import pytest
import yaml
from children import PIPE, finished
from click.testing import CliRunner

from ffsm_drake.cli import main

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "joss"
_, FRONT, TEXT = (FOLDER / "paper.md").read_text().split("---\n", 2)
SECTIONS = (
    "Summary", "Statement of need", "State of the field", "Software design",
    "Research impact statement", "AI usage disclosure",
)  # fmt: skip
PROSE = re.sub(r"^```.*?^```|^!\[.*?\)$", "", TEXT, flags=re.MULTILINE | re.DOTALL)


def section(name):
    return re.search(rf"^# {name}\n(.*?)(?=^# |\Z)", PROSE, re.MULTILINE | re.DOTALL)[1]


def test_sections_and_length():
    headings = re.findall(r"^# (.+)$", TEXT, re.MULTILINE)
    assert tuple(headings) == (*SECTIONS, "Acknowledgements", "References")
    assert 750 <= len(PROSE.split()) <= 1750
    assert 100 <= len(section("Software design").split()) <= 300
    assert all(len(section(name).split()) > 40 for name in SECTIONS)


def test_front_matter():
    front = yaml.safe_load(FRONT)
    assert front.keys() >= {"title", "tags", "authors", "affiliations", "date", "bibliography"}
    assert (FOLDER / front["bibliography"]).is_file()
    known = {each["index"] for each in front["affiliations"]}
    assert {author["affiliation"] for author in front["authors"]} <= known


def test_every_figure_names_the_commands_that_make_it():
    figures = re.findall(r"!\[(.*?)\]\((.*?)\)", TEXT, re.DOTALL)
    assert len(figures) >= 2
    for caption, file in figures:
        assert (FOLDER / file).is_file()
        commands = [text.split() for text in re.findall(r"`(.*?)`", caption)]
        assert commands, caption
        for program, *words in commands:
            if program == "python":
                assert (ROOT / words[0]).is_file(), caption
            else:
                assert program == "ffsm"
                assert CliRunner().invoke(main, [words[0], words[1], "--help"]).exit_code == 0


def test_references_are_used_and_can_be_found():
    entries = re.findall(r"^@\w+\{(\w+),(.*?)^\}", (FOLDER / "paper.bib").read_text(), re.M | re.S)
    assert {key for key, _ in entries} == set(re.findall(r"@(\w+)", TEXT))
    for key, fields in entries:
        assert re.search(r"^  (doi = \{10\.\d{4,9}/\S+\}|url = \{https://\S+\}),$", fields, re.M), (
            key
        )


def test_nothing_is_claimed_on_tools():
    """Only the authors can say it."""
    assert section("AI usage disclosure").startswith("\nTo be completed by the authors")


def test_the_doi_has_its_place_in_the_citation():
    text = (ROOT / "CITATION.cff").read_text()
    found = yaml.safe_load(re.sub(r"(?m)^# (?=doi: )", "", text))
    assert re.fullmatch(r"10\.\d{4,9}/\S+", found["doi"])


def test_the_hosted_site_installs_what_it_needs():
    found = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text())
    assert (ROOT / found["sphinx"]["configuration"]).is_file()
    assert found["sphinx"]["fail_on_warning"]
    (install,) = found["python"]["install"]
    assert install["extra_requirements"] == ["docs"]


@pytest.mark.parametrize(
    ("tag", "address", "refused"),
    [
        ("v1.2.3", "example.org", "repository's address"),
        ("v1.2.4", "real.test", "the tag is v1.2.4"),
        ("v1.2.3", "real.test", ""),
    ],
)
def test_the_release_takes_one_tag_and_no_placeholder(tag, address, refused, tmp_path):
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    steps = {each.get("name"): each for each in workflow["jobs"]["build"]["steps"]}
    (tmp_path / "pyproject.toml").write_text(f'version = "1.2.3"\nx = "https://{address}/y"\n')
    (tmp_path / "CITATION.cff").write_text("version: 1.2.3\n")
    (tmp_path / "CHANGELOG.md").write_text("## [Unreleased]\n\n## [1.2.3] - 2026-01-01\n\n- One.\n")
    done = finished(
        ["bash", "-e", "-c", steps["The tag is the version"]["run"]],
        cwd=tmp_path,
        env={"GITHUB_REF_NAME": tag, "PATH": "/usr/bin:/bin"},
        stdout=PIPE,
        text=True,
    )
    assert (done.returncode == 0) == (not refused)
    assert refused in done.stdout
    if not refused:
        assert (tmp_path / "notes.md").read_text().strip() == "- One."
