"""Words and numbers of scenarios are those of YAML 1.2's core schema, as keys and as values."""

import json
import re

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake.scenario.strict_yaml import StrictYamlError, read_yaml, write_yaml

SETTINGS = settings(derandomize=True, database=None, deadline=None, max_examples=60)
# what YAML 1.1 takes for true, false, a date, sixty-fold and octal numbers, or a default value
OLD = st.one_of(
    st.sampled_from(["y", "n", "yes", "no", "on", "off", "="]).flatmap(
        lambda word: st.sampled_from([word, word.title(), word.upper()])
    ),
    st.dates().map(str),
    st.datetimes().map(str),
    st.from_regex(r"[1-9][0-9]?:[0-5][0-9]", fullmatch=True),
    st.from_regex(r"0[0-7]+", fullmatch=True),
    st.from_regex(r"0b[01]+", fullmatch=True),
)
CORE = {
    **dict.fromkeys(["true", "True", "TRUE"], True),
    **dict.fromkeys(["false", "False", "FALSE"], False),
    **dict.fromkeys(["null", "Null", "NULL", "~", ""], None),
}
PRINTABLE = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=12)
LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), OLD, PRINTABLE
)


@SETTINGS
@given(OLD, OLD)
def test_words_of_old_yaml_are_text_as_keys_and_values(key, value):
    assert read_yaml(f"outer: {{'a': 1, {key}: {value}}}") == {"outer": {"a": 1, key: value}}
    assert read_yaml(f"? {key}\n: [{value}]") == {key: [value]}


@pytest.mark.parametrize(("word", "meant"), CORE.items())
def test_words_of_the_core_schema(word, meant):
    assert read_yaml(f"a: {word}") == {"a": meant}


@pytest.mark.long
@SETTINGS
@given(
    st.recursive(LEAVES, lambda inner: st.dictionaries(OLD | PRINTABLE, inner) | st.lists(inner))
)
def test_what_is_written_is_read_back_here_and_by_readers_of_old_yaml(data):
    assert read_yaml(write_yaml(data)) == data
    assert yaml.safe_load(write_yaml(data)) == data


@SETTINGS
@given(
    st.one_of(
        st.tuples(OLD, st.sampled_from(["{0}: 1\n{0}: 2", "{0}: 1\n'{0}': 2"])),
        st.tuples(st.integers(0, 10**6), st.sampled_from(["{0}: 1\n{0:#x}: 2", "{0}: 1\n+{0}: 2"])),
        st.tuples(st.just(None), st.sampled_from(["null: 1\n~: 2", "true: 1\nTRUE: 2"])),
    )
)
def test_a_key_given_twice_is_refused_however_it_is_written(drawn):
    key, form = drawn
    with pytest.raises(StrictYamlError, match=r"^line 2, column 1: .* is given twice"):
        read_yaml(form.format(key))


@SETTINGS
@given(st.from_regex(r"!!?[a-z/:.]{1,20}", fullmatch=True), st.sampled_from(["1", "x", "{}", "[]"]))
def test_a_tag_is_read_or_refused_in_a_line(tag, value):
    known = re.fullmatch(r"!!(str|int|float|bool|null|seq|map)", tag)
    if not known:
        with pytest.raises(StrictYamlError, match=r"^line 1, column \d+: [^\n]*$"):
            read_yaml(f"a: {tag} {value}")


@SETTINGS
@given(
    st.dictionaries(
        st.text(max_size=8), st.text(max_size=12) | st.floats(allow_nan=False, allow_infinity=False)
    )
)
def test_json_is_read_as_it_was_meant(data):
    """Each text of it, characters beyond U+FFFF included, which it may write as pairs."""
    assert read_yaml(json.dumps(data)) == data
