"""Run the tests that compare with oracles, and write the deviations that they measure to docs/data/validation.json.

python scripts/tools/measure_validation.py [--json FILE] [--list] [TESTS ...]

The tests are not written again here: pytest reports every assertion that holds, with both numbers of a comparison such
as `assert deviation < tolerance` or `assert value == pytest.approx(expected)`. `np.testing.assert_allclose` is watched
too.
docs/data/validation.yaml says which comparisons the page shows. A comparison with `approx`, or with `assert_allclose`
without `atol`, is of relative deviations. `--list` prints all comparisons of the given tests instead.
"""

from __future__ import annotations

import argparse
import datetime
import json
import linecache
import platform
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import yaml

import eyerender as er

ROOT = Path(__file__).resolve().parents[2]
CASES = ROOT / "docs" / "data" / "validation.yaml"
FIGURES = r"(-?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?![\d.])"
NUMBER = rf"\(?(?:np\.float\d+\()?(?:abs\()?{FIGURES}\)*"
COMPARISON = re.compile(rf"{NUMBER} <=? {NUMBER}")
APPROXIMATION = re.compile(rf"Obtained: {FIGURES}\s+Expected: {FIGURES} ± {FIGURES}")


@dataclass(eq=False)
class Recorder:
    """A pytest plugin that remembers the largest left side of each comparison that holds."""

    found: dict[tuple[str, str], list[tuple[float, float]]] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def pytest_assertion_pass(self, item: pytest.Item, orig: str, expl: str) -> None:
        """Note a comparison of two numbers."""
        if match := COMPARISON.match(expl.strip()):
            self.note(item.nodeid, orig, float(match[1]), float(match[2]))
        elif match := APPROXIMATION.search(expl):
            seen, expected, tolerance = map(float, match.groups())
            if expected != 0:
                self.note(item.nodeid, orig, abs(seen / expected - 1), tolerance / abs(expected))

    def note(self, test: str, source: str, value: float, limit: float) -> None:
        """Note a deviation and its limit."""
        self.found.setdefault((test.partition("[")[0], source), []).append((value, limit))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """Watch `np.testing.assert_allclose` in a test."""
        original = np.testing.assert_allclose

        def watched(actual: Any, desired: Any, rtol: float = 1e-7, atol: float = 0.0, **options: Any) -> None:
            original(actual, desired, rtol=rtol, atol=atol, **options)
            caller = sys._getframe(1)
            source = linecache.getline(caller.f_code.co_filename, caller.f_lineno).strip()
            deviation = np.abs(np.asarray(actual, dtype=float) - np.asarray(desired, dtype=float))
            if atol == 0:
                with np.errstate(divide="ignore", invalid="ignore"):
                    deviation = deviation / np.abs(np.asarray(desired, dtype=float))
            self.note(item.nodeid, source, float(np.nanmax(deviation, initial=0.0)), atol or rtol)

        with patch.object(np.testing, "assert_allclose", watched):
            return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a test that fails."""
        if report.failed:
            self.failed.append(report.nodeid)


def measured(tests: list[str]) -> Recorder:
    """Run tests and return what they compared."""
    recorder = Recorder()
    options = ["-q", "-p", "no:cacheprovider", "-o", "enable_assertion_pass_hook=true", "--timeout=600"]
    pytest.main([*options, *tests], plugins=[recorder])
    if recorder.failed:
        sys.exit(f"error: failed: {', '.join(recorder.failed)}")
    return recorder


def rows(recorder: Recorder, wanted: dict[str, list[dict[str, str]]]) -> dict[str, list[dict[str, Any]]]:
    """The rows of the page by their groups, with the deviation that takes the largest share of its tolerance."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for group, cases in wanted.items():
        groups[group] = []
        for case in cases:
            key = case["test"], case["assertion"]
            found = [
                pairs for (test, text), pairs in recorder.found.items() if test == key[0] and text.startswith(key[1])
            ]
            if not found:
                sys.exit(f"error: {key[0]} does not compare {key[1]!r}")
            pairs = [pair for some in found for pair in some]
            value, limit = max(pairs, key=lambda pair: pair[0] / pair[1])
            groups[group].append({**case, "value": value, "limit": limit, "cases": len(pairs)})
    return groups


def processor() -> str:
    """The processor's name, without that of the machine."""
    try:
        names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        names = []
    return names[0] if names else platform.machine()


def main() -> None:
    """Measure and write, or list."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=ROOT / "docs" / "data" / "validation.json")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("tests", nargs="*")
    given = parser.parse_args()
    wanted = yaml.safe_load(CASES.read_text(encoding="utf-8"))
    given.tests = given.tests or sorted({case["test"] for cases in wanted.values() for case in cases})
    recorder = measured(given.tests)
    if given.list:
        for (test, assertion), pairs in recorder.found.items():
            value, limit = max(pairs, key=lambda pair: pair[0] / (pair[1] or 1))
            print(f"{test}\t{assertion}\t{value:.3g} < {limit:.3g}\t{len(pairs)}")
        return
    document = {
        "measured": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "version": er.__version__,
        "on": f"{processor()}, Python {platform.python_version()}",
        "groups": rows(recorder, wanted),
    }
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    print(given.json)


if __name__ == "__main__":
    main()
