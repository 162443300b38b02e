"""Drake releases that the whole test suite passes with; ``ffsm doctor`` remarks on any other."""

import re

TESTED_DRAKE = ("1.51.1", "1.58.0")  # first and last


def release(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version, for comparison: "1.59.0.dev3" gives (1, 59, 0)."""
    found = re.match(r"\d+(?:\.\d+)*", version)
    return tuple(int(number) for number in found[0].split(".")) if found else ()
