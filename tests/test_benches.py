"""What the benches share: bars, the exit status, the report."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from tests.support.paths import SCRIPTS

pytestmark = pytest.mark.packaging


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import _bench

    return _bench


@pytest.mark.parametrize(
    ("value", "must", "aim", "at_least", "met"),
    [
        (1.0, 1.0, None, False, True),
        (1.1, 1.0, 2.0, False, False),
        (1.1, 1.0, None, True, True),
        (0.9, 1.0, None, True, False),
        (0, 0, None, False, True),
        (9.0, None, 1.0, False, None),  # an aim that is missed is no failure
        (np.float32("nan"), 1.0, None, False, False),
    ],
)
def test_a_row_is_met_by_what_it_must(bench, capsys, value, must, aim, at_least, met):
    row = bench.row("a name", value, "s", must, aim, at_least=at_least)
    assert row["met"] is met
    report = bench.Report()
    report.add(row)
    assert report.finish(None, ()) == (1 if met is False else 0)
    line, total = capsys.readouterr().out.splitlines()[:2]
    assert line.startswith("a name ")
    assert line.endswith({True: "met", False: "MISSED", None: "aim 1"}[met])
    assert total == f"1 rows, {int(met is False)} missed"


def test_the_report_holds_rows_machine_and_versions(bench, tmp_path):
    report = bench.Report()
    report.extend(bench.row(name, np.float64(k), "px", 1) for k, name in enumerate("abc"))
    report.add(bench.row("d", float("nan"), "px", 1))
    status = report.finish(tmp_path / "f.json", ("numpy",), machine={"device": "x"}, versions={"llvm": "1.2"})
    assert status == 1  # c is 2 and d is no number, and they must be 1
    found = json.loads((tmp_path / "f.json").read_text())
    assert found["schema"] == "eyerender/bench/1"
    assert [row["met"] for row in found["rows"]] == [True, True, False, False]
    assert [row["value"] for row in found["rows"]] == [0.0, 1.0, 2.0, None]
    assert set(found["rows"][0]) == {"name", "value", "unit", "must", "aim", "met"}
    assert found["versions"] == {"python": sys.version.split()[0], "numpy": np.__version__, "llvm": "1.2"}
    assert found["machine"]["device"] == "x"


def test_memory_is_that_of_this_process(bench):
    before = bench.resident_mib()
    block = np.ones(64_000_000)  # 488 MiB: more than what earlier tests may have left to the allocator
    assert 400 < bench.resident_mib() - before < 520
    del block


BENCHES = [path for path in sorted(SCRIPTS.glob("bench_*.py")) if "def main(" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", BENCHES, ids=lambda path: path.stem)
def test_every_bench_has_the_same_options(path):
    found = subprocess.run([sys.executable, str(path), "--help"], capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr
    assert "--quick" in found.stdout
    assert "--json" in found.stdout
