"""Expressions of xacro files, of which only a part of Python's syntax is computed.

An expression is parsed. In its tree, only the nodes below are allowed, and functions of this file
replace all names, attributes and operators that can make large results. So a file cannot reach
attributes of objects, lambdas or modules, and sizes of results are bounded.
"""

import ast
import math
import re
from collections.abc import Callable, Iterable
from typing import Any

from ffsm_drake.spacecraft.checked_urdf import require

Names = Callable[[str], Any]  # the value of a name; raises KeyError
_LONGEST = 10_000  # characters of an expression
_MOST = 300_000  # items of a sequence, characters of a text
_BITS = 100_000  # of a whole number
_WIDTH = 1000  # of a formatted number; arguments of factorials

_MAKING = (ast.List, ast.Tuple, ast.Set, ast.Dict, ast.BinOp, ast.Call)  # may grow
_ALLOWED = (
    *_MAKING, ast.Expression, ast.Constant, ast.IfExp, ast.Subscript, ast.Slice, ast.keyword,
    ast.Load, ast.Compare, ast.cmpop, ast.BoolOp, ast.boolop, ast.UnaryOp, ast.UAdd, ast.USub,
    ast.Not, ast.Add, ast.Sub, ast.Div, ast.FloorDiv,
)  # fmt: skip


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


def _product(left: Any, right: Any) -> Any:
    require(_size(left) + _size(right) <= _BITS, f"a number would have more than {_BITS} bits")
    for items, count in ((left, right), (right, left)):
        if isinstance(items, (str, list, tuple)) and isinstance(count, int):
            require(len(items) * count <= _MOST, f"a text or list of more than {_MOST} items")
    return left * right


def _power(left: Any, right: Any) -> Any:
    if isinstance(left, int) and isinstance(right, int):
        require(_size(left) * abs(right) <= _BITS, f"a power would have more than {_BITS} bits")
    return left**right


def _remainder(left: Any, right: Any) -> Any:
    """The remainder of numbers, or a format with its values."""
    if isinstance(left, str):
        widths = map(int, re.findall(r"\d+", left[:_LONGEST]))
        require(
            len(left) <= _LONGEST and "*" not in left and max(widths, default=0) <= _WIDTH,
            f"a format wider than {_WIDTH} characters",
        )
    return left % right


_LARGE: dict[type, Callable[[Any, Any], Any]] = {
    ast.Mult: _product, ast.Pow: _power, ast.Mod: _remainder,
}  # fmt: skip


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
    enumerate=lambda items, start=0: [*enumerate(items, start)],
    zip=lambda *items: [*zip(*items, strict=False)],
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

    def value_of(name: str) -> Any:
        try:
            return names(name)
        except KeyError:
            raise NameError(f"name '{name}' is not defined") from None

    def attribute_of(value: Any, name: str) -> Any:
        if isinstance(value, Space):
            require(name in value, f"the function '{name}' is unknown, or not allowed")
            return value[name]
        return attribute(value, name)

    functions = (_bounded, value_of, attribute_of, *_LARGE.values())
    tree = _Guarded().visit(ast.parse(expression.strip(), "<expression>", mode="eval"))
    code = compile(ast.fix_missing_locations(tree), "<expression>", "eval")
    return eval(code, {"__builtins__": {}} | {each.__name__: each for each in functions})


class _Guarded(ast.NodeTransformer):
    """Trees with calls of the functions of ``evaluate`` in place of what a file must not do."""

    def generic_visit(self, node: ast.AST) -> Any:
        kind = type(node).__name__
        require(isinstance(node, _ALLOWED), f"a {kind} is not allowed in an expression")
        made = super().generic_visit(node)
        return _call("_bounded", made) if isinstance(node, _MAKING) else made

    def visit_Constant(self, node: ast.Constant) -> Any:
        kinds = (int, float, str, type(None))
        require(isinstance(node.value, kinds), f"{node.value!r:.40} is not allowed")
        return node

    def visit_Name(self, node: ast.Name) -> Any:
        return _call("value_of", _checked(node.id))

    def visit_Attribute(self, node: ast.Attribute) -> Any:
        return _call("attribute_of", self.visit(node.value), _checked(node.attr))

    def visit_BinOp(self, node: ast.BinOp) -> Any:
        if (function := _LARGE.get(type(node.op))) is None:
            return self.generic_visit(node)
        operands = self.visit(node.left), self.visit(node.right)
        return _call("_bounded", _call(function.__name__, *operands))

    def visit_Dict(self, node: ast.Dict | ast.keyword) -> Any:
        names = node.keys if isinstance(node, ast.Dict) else [node.arg]
        require(None not in names, "** is not allowed in an expression")
        return self.generic_visit(node)

    visit_keyword = visit_Dict


def _call(function: str, *arguments: Any) -> ast.Call:
    return ast.Call(ast.Name(function, ast.Load()), [*arguments], [])


def _checked(name: str) -> ast.Constant:
    require(not name.startswith("__"), f"the name '{name[:40]}' is not allowed")
    return ast.Constant(name)
