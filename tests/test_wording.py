"""Numbers in messages: one thing, two things."""

import ast
import re
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
    "common/shapes.py": {"len(arguments)"},
    "plugins/audit/efforts.py": {"count"},
    "plugins/campaign/spec.py": {"spec.cases", "len(spec.distributions)"},
    "plugins/capture/before.py": {"times.size"},
    "plugins/design/stability/linearization.py": {"states"},
    "plugins/design/stability/mission.py": {"len(found.loops)"},
    "plugins/generated/tree.py": {"len(links)"},
    "plugins/new/hands.py": {"len(self._rows)"},
    "plugins/new/urdf/servicer.py": {"count"},
    "plugins/planning/planner.py": {"evaluations"},
    "plugins/planning/tables.py": {"found.evaluations"},
    "plugins/report/page.py": {"len(results)"},
    "plugins/udp/packets.py": {"packet.values.size"},
    "runs/reading.py": {"number", "time.size"},
    "spacecraft/checked_urdf.py": {"links", "shapes", "len(told)"},
    "spacecraft/plant.py": {"joint.num_velocities()"},
    "systems/controllers/checked.py": {"total"},
    "systems/part.py": {"number"},
}


def plurals(file: Path) -> set[str]:
    """Expressions of whole numbers before a plural in a file's formatted texts."""
    found = set[str]()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
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
