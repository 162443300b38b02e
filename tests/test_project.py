"""What stands about the project in several files agrees."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

from ffsm_drake.common.versions import TESTED_DRAKE, release

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text()
LOCK = (ROOT / "requirements-dev.lock").read_text()


def test_the_version_is_that_of_the_citation():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == PROJECT["version"]


def test_the_version_is_the_last_in_the_changelog():
    first, *released = re.findall(r"^## \[(.+?)\](.*)$", CHANGELOG, re.MULTILINE)
    assert first == ("Unreleased", "")
    assert released[0][0] == PROJECT["version"]
    assert all(re.fullmatch(r" - \d{4}-\d\d-\d\d", date) for _, date in released)


def test_changes_are_of_known_kinds():
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert set(re.findall(r"^### (.+)$", CHANGELOG, re.MULTILINE)) <= kinds


def test_the_first_tested_drake_is_the_first_allowed():
    assert f"drake>={TESTED_DRAKE[0]}" in PROJECT["dependencies"]


def test_the_lock_holds_versions_alone():
    pinned = r"[\w.-]+==[\w.+!-]+( ; [\w ().<>='!*]+)?"
    lines = [line for line in LOCK.splitlines() if not line.startswith("#")]
    assert [line for line in lines if not re.fullmatch(pinned, line)] == []
    assert "/" not in LOCK


@pytest.mark.parametrize(
    "requirement",
    sum(PROJECT["optional-dependencies"].values(), PROJECT["dependencies"]),
)
def test_the_lock_is_within_the_bounds(requirement):
    name, _, lowest = requirement.partition(">=")
    versions = re.findall(rf"^{name}==([\w.]+)", LOCK, re.MULTILINE | re.IGNORECASE)
    assert versions
    assert all(release(version) >= release(lowest) for version in versions)


def test_hooks_are_what_ci_lints():
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    script = (ROOT / ".ci" / "run").read_text()
    lint = re.search(r"^lint_and_types\(\) {\n(.+?)\n}", script, re.MULTILINE | re.DOTALL)
    lines = [line.strip() for line in lint[1].splitlines()]
    assert lines == [hook["entry"] for hook in repository["hooks"]]


def test_the_source_distribution_holds_what_the_metadata_are_made_of():
    hatch = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]
    hook = Path(hatch["metadata"]["hooks"]["custom"]["path"])
    assert (ROOT / hook).is_file()
    assert {"README.md", hook.parts[0]} <= set(hatch["build"]["targets"]["sdist"]["include"])


def test_the_readme_of_a_package_index_has_addresses_alone(tmp_path, monkeypatch):
    build = pytest.importorskip("hatchling.build", reason="the build backend is not installed")
    monkeypatch.chdir(ROOT)
    made = tmp_path / build.prepare_metadata_for_build_wheel(str(tmp_path)) / "METADATA"
    links = re.findall(r"\]\(([^)]+)\)", made.read_text(encoding="utf-8"))
    own = re.findall(r"\]\((?!http)([^)#]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    places = [f"{kind}/v{PROJECT['version']}" for kind in ("blob", "raw")]
    address = PROJECT["urls"]["Repository"]
    expected = {f"{address}/{place}/{path}" for place in places for path in own}
    assert own
    assert all(link.startswith("http") for link in links)
    assert len(expected & set(links)) == len(set(own))
