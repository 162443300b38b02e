"""Values of a scenario file in few lines."""

from hypothesis import given
from hypothesis import strategies as st

from ffsm_drake.plugins.new.flow_text import WIDTH, flow_text
from ffsm_drake.scenario.strict_yaml import read_yaml

NAMES = st.from_regex(r"[a-z][a-z_0-9]{0,12}", fullmatch=True)
NUMBERS = st.floats(-1e6, 1e6, width=32)
TEXTS = st.sampled_from(["debris::grasp", "package://a b/c.urdf", "null", "1", "a: b", "x, y", "#"])
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=9),
    max_leaves=60,
)


@given(key=NAMES, value=VALUES)
def test_a_value_is_read_back(key: str, value: object) -> None:
    assert read_yaml(flow_text(key, value)) == {key: value}


@given(st.dictionaries(NAMES, st.dictionaries(NAMES, NUMBERS, max_size=30), max_size=12))
def test_lines_of_mappings_are_short(value: dict[str, dict[str, float]]) -> None:
    assert max(map(len, flow_text("key", value).splitlines())) <= WIDTH
