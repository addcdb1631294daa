"""What the fuzzers share: how data are mutated, and what counts as a proper end.

A case ends properly with a result that holds no NaN, or with an `EyerenderError` of one short, printable line. It must
not take much memory (the address space is limited) or much of the processor's time (counted, so that a busy machine
changes nothing).
"""

from __future__ import annotations

import copy
import json
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from random import Random
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from eyerender.base.errors import EyerenderError

MEMORY_BYTES = 3 * 2**30  # beyond what the process has mapped before
CPU_S = 20.0


# Numbers from one seed a case: Hypothesis' own draws repeat parts of earlier cases, and many turn out alike.
CASES = st.randoms(use_true_random=True)


def budget(examples: int) -> settings:
    """Always the same cases; time is limited by `proper`, not by Hypothesis' clock."""
    return settings(
        max_examples=examples,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )


@contextmanager
def limited() -> Iterator[None]:
    """Bounds on memory and on processor time; raises `MemoryError` and `AssertionError` beyond them."""

    def late(_number: int, _frame: Any) -> None:
        raise AssertionError(f"takes more than {CPU_S:g} s of processor time")

    with open("/proc/self/statm", encoding="ascii") as file:
        mapped = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGVTALRM, late)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY_BYTES, hard))
    signal.setitimer(signal.ITIMER_VIRTUAL, CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGVTALRM, before)


def proper(call: Callable[[], Any]) -> Any:
    """The result of a case, None where it was refused; fails for every other end."""
    try:
        with limited(), np.errstate(all="ignore"):
            return call()
    except EyerenderError as error:
        message = str(error)
        assert message.isprintable(), repr(message)
        assert 0 < len(message) < 1500, len(message)
        return None


def strict_json(data: Any) -> None:
    """Fail for NaN and infinity in a result."""
    json.dumps(data, allow_nan=False)


def _nested(depth: int) -> list[Any]:
    out: list[Any] = []
    for _ in range(depth):
        out = [out]
    return out


NUMBERS = (
    0, -1, 1, 3, 7.5, -0.0, 2**31, 2**63, -(2**63) - 1, 2**64, 10**299, -(10**299), 1e-320, 1e-30, 1e-9, 1e9, -1e9,
    1e15, 1e38, 1e300, -1e308, 0.999999, 90, 180, 1e6,
)  # fmt: skip
TEXTS = (
    "", "x", "E1", "right", "../../etc/passwd", "/dev/zero", "a\x1b[31m\nb", "\x00", "ø" * 300, "x" * 20_000, "1e400",
    ".inf", "nan", "2020-13-45", "\ud800", "draw", "images/000000/../../x", "\u202e\u2028",
)  # fmt: skip
OTHERS: tuple[Any, ...] = (
    None, True, False, [], {}, [[]], {"": 1}, _nested(40), [1] * 2000, [[0, 0, 0]] * 300, {"draw": "uniform"},
    {"draw": "choice", "values": [1, "a"]}, {"draw": "integer", "low": -(10**200), "high": 10**200},
    {"draw": "grid", "low": -1e308, "high": 1e308, "steps": 1_000_000},
)  # fmt: skip
EDITS = ("nudge", "nudge", "nudge", "scale", "set", "set", "delete", "add", "swap", "repeat")


def drawn_value(rng: Random) -> Any:
    """Anything, mostly a number that is odd in some way."""
    kind = rng.randrange(8)
    if kind < 3:
        return rng.choice(NUMBERS)
    if kind < 5:
        return copy.deepcopy(rng.choice((*TEXTS, *OTHERS)))
    if kind < 7:
        return rng.uniform(-1.0, 1.0) * 10.0 ** rng.uniform(-12.0, 12.0)
    return rng.randint(-(10 ** rng.randrange(20)), 10 ** rng.randrange(20))


FACTORS = {"nudge": (0.0, 0.3, 0.8, 0.99, 1.02, 1.4, 2.5, -1.0), "scale": (1e-12, 1e-3, -1.0, 1e3, 1e12)}


def places(node: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a tree."""
    out: list[tuple[Any, Any]] = []
    todo = [node]
    while todo:
        here = todo.pop()
        items = here.items() if isinstance(here, dict) else enumerate(here) if isinstance(here, list) else ()
        for key, value in list(items):
            out.append((here, key))
            todo.append(value)
    return out


def edited(base: Any, rng: Random) -> Any:
    """A copy of a tree of dicts and lists with one to three edits."""
    tree = copy.deepcopy(base)
    for _ in range(rng.choice((1, 1, 2, 3))):
        what, at = rng.choice(EDITS), places(tree)
        if what in FACTORS:
            at = [(node, key) for node, key in at if type(node[key]) in (int, float)]
        if not at:
            continue
        node, key = rng.choice(at)
        if what in FACTORS:
            # A whole number stays one, or it would be refused for its type.
            node[key] = type(node[key])(node[key] * rng.choice(FACTORS[what]))
        elif what == "delete":
            del node[key]
        elif what == "add" and isinstance(node, dict):
            node[rng.choice((*TEXTS, *node))[:40]] = drawn_value(rng)
        elif what == "add":
            node.append(drawn_value(rng))
        elif what == "swap":
            other, name = rng.choice(at)
            node[key] = copy.deepcopy(other[name])
        elif what == "repeat" and isinstance(node[key], list):
            node[key] = node[key] * rng.randrange(400)
        else:
            node[key] = drawn_value(rng)
    return tree


SNIPPETS = (
    b"&a [*a]", b"*a", b"<<: *a", b"!!int ", b"!!python/object:os.system ", b"!!binary ", b"\n- ", b"\n  ", b": ",
    b"[" * 500, b"{" * 500, b"\x00", b"\xff\xfe", b"'", b"\t", b"%YAML 9.9\n", b"---\n", b"1" * 5000, b"2020-13-45",
    b"1:1:1:1", b"0x", b"? ", b"NaN", b"Infinity", b"1e999", b'"\\ud800"', b"null", b"\n" * 50,
)  # fmt: skip


def mutated(data: bytes, rng: Random) -> bytes:
    """A file with edits: of its values if it is JSON, or of a line of it that is, else of its bytes."""
    lines = data.splitlines(keepends=True)
    k = rng.randrange(len(lines)) if lines else 0
    for first, end in ((0, len(lines)), (k, k + 1)):
        if rng.random() < 0.6:
            with suppress(ValueError, RecursionError, OverflowError):
                lines[first:end] = [json.dumps(edited(json.loads(b"".join(lines[first:end])), rng)).encode() + b"\n"]
                return b"".join(lines)
    return garbled(data, rng)


def garbled(data: bytes, rng: Random) -> bytes:
    """Bytes with one to four edits."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        what = rng.choice(("flip", "cut", "double", "digits", "insert", "insert"))
        if what == "flip" and at < len(data):
            data = data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
        elif what == "cut":
            data = data[:at] + data[at + rng.randrange(40) :]
        elif what == "double":
            data = data[:at] + data[max(0, at - rng.randrange(400)) :]
        elif what == "digits":
            data = data[:at] + b"9" * rng.randint(1, 30) + data[at:]
        else:
            data = data[:at] + rng.choice(SNIPPETS) + data[at:]
    return data
