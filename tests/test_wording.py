"""Numbers in messages: one thing, two things."""

import ast
import functools
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import ffsm_drake
from ffsm_drake.common.numbers import counted

PACKAGE = Path(ffsm_drake.__file__).parent
# What a whole number is called here, such as len(runs), times.size, num_results(), spec.runs.
NUMBER = re.compile(
    r"len\(|int\(|n$|.*\.(size|sum\(\))$|(\w+\.)*(num_\w+|\w*(count|number|total|runs|cases|samples|"
    r"left|missing|workers|springs|poles|joints|steps|states|evaluations|links|shapes|stored|stale|"
    r"later|lost))(\(\))?$"
)
# Never one: larger by what stands before the message, or by what is computed.
ALWAYS_MANY = {
    "common/returned.py": {"total"},
    "common/shapes.py": {"len(arguments)"},
    "plugins/audit/efforts.py": {"count"},
    "plugins/campaign/spec.py": {"spec.cases", "len(spec.distributions)"},
    "plugins/capture/phases/own.py": {"times.size"},
    "plugins/design/stability/drake_sample.py": {"states"},
    "plugins/design/stability/mission.py": {"len(found.loops)"},
    "plugins/equations/tree.py": {"len(links)"},
    "plugins/new/hands.py": {"len(self._rows)"},
    "plugins/new/urdf/servicer.py": {"count"},
    "plugins/planning/planner.py": {"evaluations"},
    "plugins/planning/tables.py": {"found.evaluations"},
    "plugins/report/page.py": {"len(results)"},
    "plugins/udp/packets.py": {"packet.values.size"},
    "runs/reading.py": {"number", "time.size"},
    "spacecraft/checked_urdf.py": {"links", "shapes", "len(told)"},
    "spacecraft/plant.py": {"joint.num_velocities()"},
    "systems/parts/signals.py": {"number"},
}


@functools.cache
def nodes(file: Path) -> list[ast.AST]:
    """The syntax tree of a file, flat."""
    return [*ast.walk(ast.parse(file.read_text(encoding="utf-8")))]


def plurals(file: Path) -> set[str]:
    """Expressions of whole numbers before a plural in a file's formatted texts."""
    found = set[str]()
    for node in nodes(file):
        parts = node.values if isinstance(node, ast.JoinedStr) else []
        for value, after in pairwise(parts):
            if isinstance(value, ast.FormattedValue) and isinstance(after, ast.Constant):
                is_plural = re.match(r" (\w+ )?\w\w+s\b", str(after.value))
                expression = ast.unparse(value.value)
                if value.format_spec is None and is_plural and NUMBER.match(expression):
                    found.add(expression)
    return found


def test_a_number_that_can_be_one_is_counted():
    """``counted`` writes it; the study of the paper has fixed numbers."""
    for file in sorted(PACKAGE.rglob("*.py")):
        place = file.relative_to(PACKAGE).as_posix()
        if not place.startswith("plugins/paper/"):
            assert plurals(file) == ALWAYS_MANY.get(place, set()), place


def test_counted():
    assert [counted(n, "run") for n in range(3)] == ["0 runs", "1 run", "2 runs"]
    assert counted(1, "mocap body") == "1 mocap body"
    assert counted(3, "mocap body") == "3 mocap bodies"


LONGEST = 160  # characters of a message
VALUE = 8  # of a number or name in it


def length(node: ast.expr) -> int:
    """Characters of a text, its longer variant where it has two."""
    match node:
        case ast.Constant(value=str(text)):
            return len(text)
        case ast.JoinedStr(values=parts):
            return sum(map(length, parts))
        case ast.FormattedValue(value=ast.JoinedStr() | ast.IfExp() as inner):
            return length(inner)
        case ast.BinOp(op=ast.Add(), left=left, right=right):
            return length(left) + length(right)
        case ast.IfExp(body=body, orelse=other):
            return max(length(body), length(other))
    return VALUE


def errors(file: Path) -> Iterator[tuple[int, int]]:
    """Line and length of each text of an error in a file."""
    for node in nodes(file):
        name = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
        if name.endswith("Error") or name == "require":
            texts = [each for each in node.args if not isinstance(each, ast.Starred)]
            yield node.lineno, max(map(length, texts), default=0)


def test_errors_are_short():
    found = {f"{file}:{line}": size for file in PACKAGE.rglob("*.py")
             for line, size in errors(file) if size > LONGEST}  # fmt: skip
    assert found == {}


# Idioms of this project, and the words that a reader knows.
WORDS = {
    r"\bwanted\b": "commanded, required",
    r"\blikewise\b": "repeat the noun",
    r"\bbesides\b": "next to, in addition to",
    r"\bis told\b|\bsays\b|\bhears\b|\bwants\b": "prints, reports",
    r"\beither way\b|\bboth ways\b": "in both directions",
    r"\boff by\b": "differs by",
    r"\b(takes?|took|taken) out\b": "removes",
    r"\bgiven gains\b": "current gains",
    r"\bhidden coordinates?\b": "flexible parts",
    r"\bas wired\b": "with all blocks",
}


def spoken(file: Path) -> Iterator[str]:
    """Texts of a file that are no docstrings."""
    silent = {id(node.value) for node in nodes(file) if isinstance(node, ast.Expr)}
    for node in nodes(file):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield "" if id(node) in silent else node.value


def test_outputs_have_the_words_of_the_field():
    any_word = re.compile("|".join(WORDS))
    found = [
        (file.name, text, instead)
        for file in PACKAGE.rglob("*.py")
        for text in spoken(file)
        if " " in text and any_word.search(text)
        for word, instead in WORDS.items()
        if re.search(word, text)
    ]
    assert found == []
