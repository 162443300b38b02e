"""Expressions of xacro files, computed without running them as Python.

An expression is parsed, and its tree is walked: only the nodes and functions below have a meaning.
So a file cannot reach attributes of objects, lambdas or modules, and sizes of results are bounded.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from ffsm_drake.common.errors import ModelError
from ffsm_drake.spacecraft.checked_urdf import require

Names = Callable[[str], Any]  # the value of a name; raises KeyError
_LONGEST = 10_000  # characters of an expression
_MOST = 300_000  # items of a sequence, characters of a text
_BITS = 100_000  # of a whole number
_WIDTH = 1000  # of a formatted number; arguments of factorials

_COMPARED: dict[type, Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le,
    ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Is: operator.is_, ast.IsNot: operator.is_not,
    ast.In: lambda item, items: item in items, ast.NotIn: lambda item, items: item not in items,
}  # fmt: skip
_COMPUTED: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Mod: operator.mod,
    ast.Div: operator.truediv, ast.FloorDiv: operator.floordiv, ast.Pow: operator.pow,
}  # fmt: skip
_HOLDERS: dict[type, Callable[[Any], Any]] = {ast.List: list, ast.Tuple: tuple, ast.Set: set}
_MAKING = (ast.List, ast.Tuple, ast.Set, ast.Dict, ast.BinOp, ast.Call)  # may grow
_SIGNED: dict[type, Callable[[Any], Any]] = {
    ast.UAdd: operator.pos, ast.USub: operator.neg, ast.Not: operator.not_,
}  # fmt: skip


class Space(dict[str, Any]):
    """A namespace whose names are written after a dot."""


def _bounded(value: Any) -> Any:
    """The value, if it is not too large with all that it holds, each time that it holds it."""
    pending, size = [value], 0
    while pending:
        each = pending.pop()
        size += len(each) if isinstance(each, str) else 1
        require(size <= _MOST, f"a text or list would have more than {_MOST} items")
        if isinstance(each, dict):
            pending += [*each, *each.values()]
        elif isinstance(each, (list, tuple, set, frozenset)):
            pending += each
    return value


def _size(value: Any) -> int:
    """Bits of a whole number."""
    return value.bit_length() if isinstance(value, int) else 0


def _check_operands(kind: type, left: Any, right: Any) -> None:
    """Raise ModelError where the result would be too large to compute."""
    sequences = (str, list, tuple)
    if kind is ast.Mult:
        require(_size(left) + _size(right) <= _BITS, f"a number would have more than {_BITS} bits")
        for items, count in ((left, right), (right, left)):
            if isinstance(items, sequences) and isinstance(count, int):
                require(len(items) * count <= _MOST, f"a text or list of more than {_MOST} items")
    elif kind is ast.Pow and isinstance(left, int) and isinstance(right, int):
        require(_size(left) * abs(right) <= _BITS, f"a power would have more than {_BITS} bits")
    elif kind is ast.Mod and isinstance(left, str):
        widths = map(int, re.findall(r"\d+", left[:_LONGEST]))
        require(
            len(left) <= _LONGEST and "*" not in left and max(widths, default=0) <= _WIDTH,
            f"a format wider than {_WIDTH} characters",
        )


def _small(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of whole numbers that grows with their size, for small ones."""

    def of_small(*values: Any) -> Any:
        require(all(abs(value) <= _WIDTH for value in values), f"an argument above {_WIDTH}")
        return function(*values)

    return of_small


def _range(*ends: int) -> range:
    made = range(*ends)
    require(len(made) <= _MOST, f"a range of more than {_MOST} items")
    return made


def _round(value: Any, digits: int | None = None) -> Any:
    require(digits is None or abs(digits) <= _WIDTH, f"a number of digits above {_WIDTH}")
    return round(value, digits)


def _sum(values: Iterable[Any], start: Any = 0) -> Any:
    for value in values:
        start = _bounded(start + value)
    return start


_MATH = Space({name: value for name, value in vars(math).items() if not name.startswith("_")})
_MATH |= {name: _small(_MATH[name]) for name in ("factorial", "comb", "perm") if name in _MATH}
_COMMON = Space(
    list=list, dict=dict, len=len, str=str, float=float, int=int, bool=bool, min=min, max=max,
    round=_round, map=lambda function, *values: [*map(function, *values)],
)  # fmt: skip
_PYTHON = Space(
    _COMMON, abs=abs, all=all, any=any, divmod=divmod, frozenset=frozenset, ord=ord, repr=repr,
    set=set, sum=_sum, tuple=tuple, sorted=sorted, range=_range, isinstance=isinstance,
    enumerate=lambda items, start=0: [*enumerate(items, start)], zip=lambda *items: [*zip(*items)],  # noqa: B905
    reversed=lambda items: [*reversed(items)],
    filter=lambda function, items: [*filter(function, items)],
)  # fmt: skip
# What xacro gives every expression; its own functions come from ``xacro.py``.
KNOWN = {**_MATH, **_COMMON, "sorted": sorted, "range": _range, "python": _PYTHON, "math": _MATH}
EVAL_KNOWN = {  # what it gives $(eval ...)
    **_MATH, **{name: _COMMON[name] for name in ("list", "dict", "map", "str", "float", "int")},
    "true": True, "false": False,
}  # fmt: skip


def evaluate(expression: str, names: Names, attribute: Callable[[Any, str], Any]) -> Any:
    """The value of an expression.

    Args:
      expression: Python's syntax of numbers, texts, lists, dictionaries, names, arithmetic,
        comparisons, conditions, subscripts and calls.
      names: gives the value of a name.
      attribute: gives what stands after a dot, of a value that is no Space.

    Raises:
      ModelError: it holds anything else, or its value would be too large.
      Exception: what Python raises for it, such as a division by zero.
    """
    require(len(expression) <= _LONGEST, f"an expression of more than {_LONGEST} characters")
    return _Walk(names, attribute).value(
        ast.parse(expression.strip(), "<expression>", mode="eval").body
    )


class _Walk:
    """The values of nodes."""

    def __init__(self, names: Names, attribute: Callable[[Any, str], Any]) -> None:
        self.names, self.attribute = names, attribute

    def value(self, node: Any) -> Any:
        method = getattr(self, f"of_{type(node).__name__.lower()}", None)
        if method is None:
            raise ModelError(f"a {type(node).__name__} is not allowed in an expression")
        return _bounded(method(node)) if isinstance(node, _MAKING) else method(node)

    def of_constant(self, node: ast.Constant) -> Any:
        kinds = (int, float, str, type(None))
        require(isinstance(node.value, kinds), f"{node.value!r:.40} is not allowed")
        return node.value

    def of_name(self, node: ast.Name) -> Any:
        _check_name(node.id)
        try:
            return self.names(node.id)
        except KeyError:
            raise NameError(f"name '{node.id}' is not defined") from None

    def of_attribute(self, node: ast.Attribute) -> Any:
        _check_name(node.attr)
        value = self.value(node.value)
        if isinstance(value, Space):
            require(node.attr in value, f"the function '{node.attr}' is unknown, or not allowed")
            return value[node.attr]
        return self.attribute(value, node.attr)

    def of_binop(self, node: ast.BinOp) -> Any:
        require(type(node.op) in _COMPUTED, f"{type(node.op).__name__} is not allowed")
        left, right = self.value(node.left), self.value(node.right)
        _check_operands(type(node.op), left, right)
        return _COMPUTED[type(node.op)](left, right)

    def of_unaryop(self, node: ast.UnaryOp) -> Any:
        require(type(node.op) in _SIGNED, f"{type(node.op).__name__} is not allowed")
        return _SIGNED[type(node.op)](self.value(node.operand))

    def of_boolop(self, node: ast.BoolOp) -> Any:
        value = None
        for each in node.values:
            value = self.value(each)
            if bool(value) == isinstance(node.op, ast.Or):
                break
        return value

    def of_compare(self, node: ast.Compare) -> Any:
        left, found = self.value(node.left), True
        for kind, each in zip(node.ops, node.comparators, strict=True):
            right = self.value(each)
            found = _COMPARED[type(kind)](left, right)
            if not found:
                break
            left = right
        return found

    def of_ifexp(self, node: ast.IfExp) -> Any:
        return self.value(node.body if self.value(node.test) else node.orelse)

    def of_subscript(self, node: ast.Subscript) -> Any:
        return self.value(node.value)[self.value(node.slice)]

    def of_slice(self, node: ast.Slice) -> slice:
        return slice(*(each and self.value(each) for each in (node.lower, node.upper, node.step)))

    def of_items(self, node: ast.List | ast.Tuple | ast.Set) -> Any:
        return _HOLDERS[type(node)](map(self.value, node.elts))

    of_list = of_tuple = of_set = of_items

    def of_dict(self, node: ast.Dict) -> dict[Any, Any]:
        pairs = zip(node.keys, node.values, strict=True)
        return {self.value(key): self.value(value) for key, value in pairs}

    def of_call(self, node: ast.Call) -> Any:
        function = self.value(node.func)
        require(callable(function), f"'{ast.unparse(node.func)[:40]}' is not a function")
        given: Mapping[str, Any] = {str(each.arg): self.value(each.value) for each in node.keywords}
        require("None" not in given, "** is not allowed in an expression")
        return function(*map(self.value, node.args), **given)


def _check_name(name: str) -> None:
    require(not name.startswith("__"), f"the name '{name[:40]}' is not allowed")
