"""Versions compare as numbers; what follows the numbers does not count."""

import pytest

from ffsm_drake.common.versions import TESTED_DRAKE, release


@pytest.mark.parametrize(
    ("version", "numbers"),
    [
        ("1.51.1", (1, 51, 1)),
        ("1.59.0.dev3", (1, 59, 0)),
        ("1.59.0rc1", (1, 59, 0)),
        ("1.60+local", (1, 60)),
        ("0.0.20260101", (0, 0, 20260101)),
    ],
)
@pytest.mark.smoke
def test_release(version, numbers):
    assert release(version) == numbers


@pytest.mark.smoke
def test_the_tested_range_is_one():
    first, last = map(release, TESTED_DRAKE)
    assert len(first) == len(last) == 3
    assert first < last
