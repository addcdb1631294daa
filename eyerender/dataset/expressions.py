"""References to variables in a template, `{var: EXPRESSION}`: arithmetic on drawn values, nothing else.

An expression holds numbers, names of variables, `name.column` of a table's row, `name[k]` of a vector, + - * / **, and
the functions in `FUNCTIONS`. Python's parser reads it, and this module computes it node by node; nothing is executed.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

from ..base.errors import InputError

REFERENCE = "var"
MAX_LENGTH = 200
FUNCTIONS: dict[str, Callable[..., float]] = {
    "abs": abs,
    "min": min,
    "max": max,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "log": math.log,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "radians": math.radians,
    "degrees": math.degrees,
}
_BINARY: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: lambda a, b: math.pow(a, b),
}
_UNARY: dict[type[ast.unaryop], Callable[[float], float]] = {ast.USub: operator.neg, ast.UAdd: operator.pos}


def is_reference(node: object) -> bool:
    """Return whether a node of a template refers to variables."""
    return isinstance(node, dict) and REFERENCE in node


def names_of(text: str) -> set[str]:
    """Return the names of the variables in an expression; InputError if the text is not such an expression."""
    tree, _ = _parsed(text)
    functions = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in functions}


def evaluate(text: str, variables: Mapping[str, Any]) -> Any:
    """Evaluate an expression: a number, or the variable's own value if the expression is only a name.

    Raises:
        InputError: the value cannot be computed, or is neither a finite number nor a list of such.
    """
    _, value_of = _parsed(text)
    try:
        value = value_of(variables)
    except (ArithmeticError, ValueError, TypeError, LookupError) as error:
        raise InputError(f"{text!r} cannot be computed ({type(error).__name__}: {error})") from None
    if not all(_is_number(v) for v in (value if isinstance(value, list | tuple) else [value])):
        raise InputError(f"{text!r} is not a number")
    return value


@lru_cache(maxsize=1024)
def _parsed(text: str) -> tuple[ast.Expression, Callable[[Mapping[str, Any]], Any]]:
    """Parse an expression; return its tree, and the function that computes it from the variables."""
    if len(text) > MAX_LENGTH:
        raise InputError(f"has more than {MAX_LENGTH} characters")
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise InputError(f"{text!r} is not an expression") from None
    return tree, _function_of(tree.body, text)


def _function_of(node: ast.expr, text: str) -> Callable[[Mapping[str, Any]], Any]:
    """Return the function that computes a node from the variables; refuse what is no arithmetic."""
    match node:
        case ast.Constant(value=value) if _is_number(value):
            return lambda _: value
        case ast.Name(id=name):
            return lambda variables: variables[name]
        case ast.Attribute(value=ast.Name(id=name), attr=key):
            return lambda variables: variables[name][key]
        case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=int(k))):
            return lambda variables: variables[name][k]
        case ast.UnaryOp(op=op, operand=inner) if type(op) in _UNARY:
            operation: Callable[..., float] = _UNARY[type(op)]
            parts = [inner]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            operation, parts = _BINARY[type(op)], [left, right]
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS and arguments:
            operation, parts = FUNCTIONS[name], arguments
        case _:
            raise InputError(f"{text!r} is not made of numbers, variables, + - * / ** and {', '.join(FUNCTIONS)}")
    functions = [_function_of(part, text) for part in parts]
    return lambda variables: operation(*(_number(function(variables)) for function in functions))


def _number(value: Any) -> float:
    if not _is_number(value):
        raise TypeError(f"{value!r} is not a number")
    return float(value)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
