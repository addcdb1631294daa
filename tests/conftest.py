"""What all tests share.

The backend is chosen before any test module is imported: Dr.Jit loads a libLLVM when mitsuba is first imported, and
keeps it. Without a backend the tests that render are skipped on a developer's machine and fail in continuous
integration.
"""

from __future__ import annotations

import ctypes
import os
import signal
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from eyerender.backends.choose import choose_backend
from eyerender.base.errors import BackendError
from tests.support.quick import Quick, Recorder, listed, name_of

# A shell that starts the suite in the background ignores Ctrl-C for it, and the processes that tests interrupt would
# inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

try:
    choose_backend("llvm")
except BackendError:
    if os.environ.get("CI"):
        raise


@pytest.fixture(scope="session", autouse=True)
def _single_workers_in_process() -> Iterator[None]:
    """Start no process for runs of one worker, except where a test runs the command itself."""
    from tests.support.in_process import single_workers_in_process

    with single_workers_in_process():
        yield


def pytest_addoption(parser: pytest.Parser) -> None:
    """Register the options of scripts/test that are pytest's too."""
    parser.addoption("--fast", action="store_true", help="leave out what tests/data/not_quick.txt lists")
    parser.addoption("--record", action="store_true", help="write tests/data/not_quick.txt")
    parser.addoption("--avx2", action="store_true", help="render with code for AVX2, whatever the processor has")


def pytest_configure(config: pytest.Config) -> None:
    """Measure the tests, or choose the code to render with, where that is asked for."""
    if config.getoption("--record"):
        config.pluginmanager.register(Recorder())
    if config.getoption("--avx2"):
        import drjit

        core = ctypes.CDLL(str(Path(drjit.__file__).with_name("libdrjit-core.so")))
        core._Z19jit_llvm_set_targetPKcS0_j(b"haswell", None, 8)  # no binding in Python


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is not quick where only quick tests are asked for; put the files that take longest first.

    Files with the longest proofs come first, then those with the most tests that are not quick. The many files of quick
    tests come last, so that all processes end at about the same time. Only tests that will run count: this hook comes
    after the choice by marks.
    """
    is_quick = Quick(listed())
    if config.getoption("--fast"):
        config.hook.pytest_deselected(items=[item for item in items if not is_quick(item)])
        items[:] = [item for item in items if is_quick(item)]
    longest_s: Counter[Path] = Counter()
    not_quick: defaultdict[Path, set[str]] = defaultdict(set)
    for item in items:
        allowed = item.get_closest_marker("timeout")
        longest_s[item.path] = max(longest_s[item.path], int(allowed.args[0]) if allowed else 0)
        if not is_quick(item):
            not_quick[item.path].add(name_of(item))
    items.sort(key=lambda item: (-longest_s[item.path], -len(not_quick[item.path])))  # the others keep their order
