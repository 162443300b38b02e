"""How many tests pytest commands select.

``python tests/selected_tests.py FILE`` reads a JSON list of commands, each a list of words after
``pytest``, and prints a JSON list of numbers. All tests are collected once, without marks.
"""

import argparse
import contextlib
import json
import sys
import tomllib
from pathlib import Path

import pytest
from _pytest.mark import KeywordMatcher, MarkMatcher
from _pytest.mark.expression import Expression

ROOT = Path(__file__).parents[1]


class Collected:
    """A plug-in of pytest that keeps the collected tests."""

    items: tuple[pytest.Item, ...] = ()

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self.items = tuple(session.items)


def default_marks() -> str:
    """The mark expression of the project, for a command without ``-m``."""
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    return options["addopts"].split("-m '")[1].split("'")[0]


def arguments(words: list[str]) -> argparse.Namespace:
    """The choice of tests in a command: ``marks``, ``keywords`` and ``paths``.

    Raises:
        SystemExit: for an option that evidence pages do not use.
    """
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("-m", dest="marks", default=default_marks())
    parser.add_argument("-k", dest="keywords", default="")
    parser.add_argument("-n", dest="workers")
    parser.add_argument("-s", "-q", dest="shown", action="store_true")
    parser.add_argument("paths", nargs="*")
    return parser.parse_args(words)


def lies_in(item: pytest.Item, path: str) -> bool:
    """Whether a test is in a file or folder, or is the function after ``::``."""
    file, _, name = path.partition("::")
    if name:
        return item.path == ROOT / file and item.nodeid.split("::", 1)[1].split("[")[0] == name
    return item.path.is_relative_to(ROOT / file)


def number_of(items: tuple[pytest.Item, ...], words: list[str]) -> int:
    """How many of the collected tests a command runs, by pytest's own expressions."""
    given = arguments(words)
    marks = Expression.compile(given.marks) if given.marks else None
    keywords = Expression.compile(given.keywords) if given.keywords else None
    return sum(
        (not given.paths or any(lies_in(item, path) for path in given.paths))
        and (not marks or marks.evaluate(MarkMatcher.from_markers(item.iter_markers())))
        and (not keywords or keywords.evaluate(KeywordMatcher.from_item(item)))
        for item in items
    )


def main() -> None:
    commands = json.loads(Path(sys.argv[1]).read_text())
    collected = Collected()
    with contextlib.redirect_stdout(sys.stderr):
        code = pytest.main(["--collect-only", "-q", "-m", "", str(ROOT / "tests")], [collected])
    if code:
        sys.exit(int(code))
    print(json.dumps([number_of(collected.items, words) for words in commands]))


if __name__ == "__main__":
    main()
