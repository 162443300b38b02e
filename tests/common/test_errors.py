"""Texts of errors: short, and with numbers of few digits."""

import numpy as np
import pytest

from ffsm_drake.common.errors import ScenarioError, some
from ffsm_drake.common.numbers import number


def test_a_list_of_names_is_short_and_counts_the_others():
    draw = np.random.default_rng(0)
    for _ in range(200):
        lengths = draw.integers(1, 25, draw.integers(0, 40))
        names = ["n" * length for length in lengths]
        text = some(names)
        assert len(text) <= 90
        shown, _, more = text.partition(" and ")
        count = len(shown.split(", ")) if names else 0
        assert count + int(more.split()[0] if more else 0) == len(names)
    assert some([]) == "none"
    assert some(["a", "b"]) == "a, b"


@pytest.mark.parametrize(
    ("source", "text"), [("--set", "--set k: bad"), ("mine.yaml", "mine.yaml: k: bad")]
)
def test_an_error_begins_with_what_the_user_typed(source, text):
    assert str(ScenarioError("k", "bad", source=source)) == text


def test_numbers_have_the_digits_asked_for():
    for value in 10.0 ** np.random.default_rng(1).uniform(-300, 300, 200):
        mantissa = number(value, 3).partition("\u00d7")[0]
        assert len(mantissa.replace(".", "").lstrip("0")) <= 5, value
