"""Strict YAML for settings: input that PyYAML would silently ignore or expand without limit is
refused.
"""

import re
from typing import Any

import yaml

from ffsm_drake.common.memo import memoized

MAX_DEPTH = 50
MAX_NODES = 100_000  # with every alias written out
_TAG = "tag:yaml.org,2002:"


class StrictYamlError(ValueError):
    """Text that is not valid YAML for settings; the error is one line, beginning with the place."""


class _StrictLoader(yaml.SafeLoader):
    """Safe YAML of the 1.2 core schema with merge keys; it refuses duplicate keys, other tags, and
    deep nesting.
    """

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise StrictYamlError(
                f"{_place(self.get_mark())}: nested deeper than {MAX_DEPTH} levels"
            )
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def compose_mapping_node(self, anchor: Any) -> Any:
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        first: dict[Any, Any] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag == _TAG + "merge":
                continue
            # by value: 1 and 0x1 are one key, as are ~ and null
            earlier = first.setdefault(self.construct_object(key), key)
            if earlier is not key:
                raise StrictYamlError(
                    f"{_place(key.start_mark)}: '{key.value}' is given twice, first in line "
                    f"{earlier.start_mark.line + 1}; keep one"
                )
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (yaml.YAMLError, StrictYamlError):
            raise
        except (ValueError, KeyError, IndexError, AttributeError, TypeError) as error:
            # PyYAML builds dates and numbers without checks; an error raised by Python passes
            # unchanged.
            text = " ".join(str(error).split()) or type(error).__name__
            raise StrictYamlError(f"{_place(node.start_mark)}: {text}") from error

    def construct_text(self, node: yaml.ScalarNode) -> str:
        """Return a text; escaped characters beyond U+FFFF may be surrogate pairs, as in JSON."""
        text = str(self.construct_scalar(node))
        return text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")


class _Dumper(yaml.SafeDumper):
    """Quotes text that this or a usual reader would take for another type."""


# The words and numbers of YAML 1.2's core schema and JSON. YAML 1.1, which PyYAML reads, takes on
# and yes for true, 1:30 for 90, 017 for 15, 2026-01-31 for a date, and 1e-5 for text.
_CORE = {
    "bool": (r"(true|True|TRUE|false|False|FALSE)$", "tTfF"),
    "null": (r"(null|Null|NULL|~|)$", ["n", "N", "~", ""]),
    "int": (r"[-+]?(0|[1-9][0-9_]*)$|0x[0-9a-fA-F]+$", "-+0123456789"),
    "float": (
        r"[-+]?([0-9][0-9_]*\.[0-9_]*|\.[0-9]+|[0-9][0-9_]*(?=[eE]))([eE][-+]?[0-9]+)?$"
        r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$",
        "-+.0123456789",
    ),
    "merge": (r"<<$", "<"),
}
_StrictLoader.yaml_implicit_resolvers = {}
_StrictLoader.yaml_constructors = {
    tag: make
    for tag, make in yaml.SafeLoader.yaml_constructors.items()
    if tag is None or tag.removeprefix(_TAG) in ("str", "seq", "map", *_CORE)
}
_StrictLoader.add_constructor(_TAG + "str", _StrictLoader.construct_text)
for _name, (_form, _first) in _CORE.items():
    for _side in (_StrictLoader, _Dumper):
        _side.add_implicit_resolver(_TAG + _name, re.compile(_form), list(_first))


@memoized(maxsize=64)  # the shipped files are read again and again, and PyYAML is slow
def read_yaml(text: str) -> Any:
    """Plain data (mappings, lists, leaves) of one YAML document; None for an empty one.

    Raises StrictYamlError: not YAML, a key given twice, a tag, aliases that multiply or are
    circular, deep nesting.
    """
    try:
        loader = _StrictLoader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            if _expanded_size(node, {}) > MAX_NODES:
                raise StrictYamlError(
                    f"aliases (*name) expand to more than {MAX_NODES} values; write less"
                )
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except StrictYamlError:
        raise
    except yaml.MarkedYAMLError as error:
        raise StrictYamlError(_described(error)) from error
    except yaml.reader.ReaderError as error:
        raise StrictYamlError(f"character {error.position + 1}: {error.reason}") from error


def write_yaml(data: Any, **layout: Any) -> str:
    """Plain data as YAML text that ``read_yaml`` reads back unchanged; layout options are
    PyYAML's.
    """
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, **layout)


def _described(error: yaml.MarkedYAMLError) -> str:
    problem = " ".join((error.problem or error.context or "cannot be read").split())
    if error.context and problem.startswith("but "):
        problem = f"{error.context} {problem}"
    if "\\t" in problem:
        problem += "; indent with spaces, not tabs"
    if "could not determine a constructor" in problem:
        problem = (
            f"{problem.removeprefix('could not determine a constructor for the ')} is not "
            "accepted; leave it out"
        )
    mark = error.problem_mark or error.context_mark
    return f"{_place(mark)}: {problem}" if mark is not None else problem


def _place(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}"


def _expanded_size(node: yaml.Node, known: dict[int, int | None]) -> int:
    """Number of nodes with every alias written out; ``known`` holds None for a node in progress."""
    if id(node) in known:
        size = known[id(node)]
        if size is None:
            raise StrictYamlError(
                f"{_place(node.start_mark)}: contains itself through an alias (*name)"
            )
        return size
    known[id(node)] = None
    size = 1
    if isinstance(node, yaml.MappingNode):
        size += sum(_expanded_size(part, known) for pair in node.value for part in pair)
    elif isinstance(node, yaml.SequenceNode):
        size += sum(_expanded_size(part, known) for part in node.value)
    known[id(node)] = size
    return size
