"""Which tests are quick: those for `./scripts/test --fast`.

The file tests/data/not_quick.txt lists the tests and fixtures that are not. `./scripts/test --record` measures
them all and writes it. A test that it does not name is quick.
The mark `fast` puts a test among the quick ones however long it takes. Times are processor seconds, with those of child
processes, so that they come out alike on a busy machine.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

PLACE = Path(__file__).resolve().parents[1] / "data" / "not_quick.txt"
QUICK_S = 0.5  # what takes longer is not quick


def processor_s() -> float:
    """Processor time of this process and its finished children."""
    return sum(os.times()[:4])


def name_of(item: pytest.Item) -> str:
    """A test function's name; all its parameters count together."""
    return item.nodeid.partition("[")[0]


class Recorder:
    """A plugin that measures tests and fixtures, and writes the list when all have run."""

    def __init__(self, place: Path = PLACE, quick_s: float = QUICK_S) -> None:
        self.place, self.quick_s = place, quick_s
        self.seconds: dict[str, float] = defaultdict(float)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """Measure a test without its fixtures."""
        with self._measured(name_of(item)):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
        """Measure a fixture without those that it needs."""
        with self._measured(f"{fixturedef.baseid}::{fixturedef.argname}"):
            return (yield)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Take the times of a process that has run a part of the tests (pytest-xdist)."""
        for name, seconds in getattr(node, "workeroutput", {}).get("seconds", {}).items():
            self.seconds[name] += seconds

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Write the list, or send the times to the process that does."""
        output = getattr(session.config, "workeroutput", None)
        if output is not None:
            output["seconds"] = dict(self.seconds)
        elif exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            names = [name for name, seconds in self.seconds.items() if seconds > self.quick_s]
            self.place.write_text("".join(f"{name}\n" for name in sorted(names)), encoding="utf-8")

    @contextmanager
    def _measured(self, name: str) -> Iterator[None]:
        before = processor_s()
        try:
            yield
        finally:
            self.seconds[name] += processor_s() - before


def listed(place: Path = PLACE) -> list[str]:
    """Tests and fixtures that are not quick: `tests/test_spec.py::name`, of a conftest.py `tests/dataset::name`."""
    return place.read_text(encoding="utf-8").splitlines() if place.exists() else []


class Quick:
    """Tells quick tests from those that are listed or need a fixture that is."""

    def __init__(self, names: Iterable[str]) -> None:
        self._names = set(names)
        self._places: dict[str, list[str]] = defaultdict(list)
        for place, _, last in (name.rpartition("::") for name in self._names):
            self._places[last].append(place)

    def __call__(self, item: pytest.Item) -> bool:
        """Whether a test is quick, or marked `fast`."""
        if item.get_closest_marker("fast"):
            return True
        places = (place for name in getattr(item, "fixturenames", ()) for place in self._places[name])
        return name_of(item) not in self._names and not any(item.nodeid.startswith(place) for place in places)
