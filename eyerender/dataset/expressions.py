"""References to variables in a template, `{var: EXPRESSION}`: arithmetic on drawn values, nothing else.

An expression holds numbers, names of variables, `name.column` of a table's row, `name[k]` of a vector, + - * / **, and
the functions in `FUNCTIONS`. Python's parser reads it, and this module evaluates it node by node; nothing is executed.
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
    """Return the names of the variables in an expression.

    Raises:
        InputError: the text is not such an expression.
    """
    tree = _parsed(text)
    functions = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in functions}


def evaluate(text: str, variables: Mapping[str, Any]) -> Any:
    """Evaluate an expression: a number, or the variable's own value if the expression is only a name.

    Raises:
        InputError: the value cannot be computed, or is neither a finite number nor a list of such.
    """
    try:
        value = _value(_parsed(text).body, variables)
    except InputError:
        raise
    except (ArithmeticError, ValueError, TypeError, LookupError) as error:
        raise InputError(f"{text!r} cannot be computed ({type(error).__name__}: {error})") from None
    if not all(_is_number(v) for v in (value if isinstance(value, list | tuple) else [value])):
        raise InputError(f"{text!r} is not a number")
    return value


@lru_cache(maxsize=1024)
def _parsed(text: str) -> ast.Expression:
    if len(text) > MAX_LENGTH:
        raise InputError(f"has more than {MAX_LENGTH} characters")
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise InputError(f"{text!r} is not an expression") from None
    _check(tree.body, text)
    return tree


def _check(node: ast.expr, text: str) -> None:
    """Check that an expression contains only what `_value` can compute."""
    match node:
        case ast.Constant(value=value) if _is_number(value):
            return
        case ast.Name():
            return
        case ast.Attribute(value=ast.Name()) | ast.Subscript(value=ast.Name(), slice=ast.Constant(value=int())):
            return
        case ast.UnaryOp(op=op, operand=inner) if type(op) in _UNARY:
            _check(inner, text)
        case ast.BinOp(left=left, op=operation, right=right) if type(operation) in _BINARY:
            _check(left, text)
            _check(right, text)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS and arguments:
            for argument in arguments:
                _check(argument, text)
        case _:
            raise InputError(f"{text!r} is not made of numbers, variables, + - * / ** and {', '.join(FUNCTIONS)}")


def _value(node: ast.expr, variables: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=value):
            return value
        case ast.Name(id=name):
            return variables[name]
        case ast.Attribute(value=ast.Name(id=name), attr=key):
            return variables[name][key]
        case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=int(k))):
            return variables[name][k]
        case ast.UnaryOp(op=op, operand=inner):
            return _UNARY[type(op)](_number(_value(inner, variables)))
        case ast.BinOp(left=left, op=operation, right=right):
            return _BINARY[type(operation)](_number(_value(left, variables)), _number(_value(right, variables)))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name](*(_number(_value(argument, variables)) for argument in arguments))
    raise TypeError(type(node).__name__)


def _number(value: Any) -> float:
    if not _is_number(value):
        raise TypeError(f"{value!r} is not a number")
    return float(value)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
