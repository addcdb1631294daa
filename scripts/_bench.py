"""Code that the benches share: options, rows with their limits, the table, the JSON report, the exit status."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

SCHEMA = "eyerender/bench/1"
Row = dict[str, Any]


def single_threaded() -> None:
    """Numerical libraries take one thread, where nothing else is set; to be called before they are imported."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def options_of(doc: str | None, quick: str) -> argparse.ArgumentParser:
    """The options that every bench has; `quick` says what --quick leaves out."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--json", metavar="F", type=Path, help="write the rows to a file")
    return parser


def row(
    name: str, value: float, unit: str, must: float | None = None, aim: float | None = None, *, at_least: bool = False
) -> Row:
    """A result. `must` and `aim` are upper bars, lower ones with `at_least`; `met` is of `must` alone."""
    met = None if must is None else bool(value >= must if at_least else value <= must)
    return {"name": name, "value": float(value), "unit": unit, "must": must, "aim": aim, "met": met}


class Report:
    """The rows of a bench, printed as they come."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def add(self, found: Row) -> None:
        """Take and print a row."""
        self.rows.append(found)
        bars = "".join(f"  {bar} {found[bar]:g}" for bar in ("must", "aim") if found[bar] is not None)
        mark = {True: "  met", False: "  MISSED", None: ""}[found["met"]]
        print(f"{found['name']:<66} {found['value']:>11.5g} {found['unit']:<10}{bars}{mark}", flush=True)

    def extend(self, rows: Iterable[Row]) -> None:
        """Take rows, each printed when it is measured."""
        for found in rows:
            self.add(found)

    def finish(
        self, path: Path | None, packages: Iterable[str], *, machine: Row | None = None, versions: Row | None = None
    ) -> int:
        """Sum up, write the rows to a file where one is asked for, and give the exit status: 1 when a `must` is missed.

        The file tells the versions of `packages`; `machine` and `versions` are what it tells besides.
        """
        missed = [found["name"] for found in self.rows if found["met"] is False]
        print(f"{len(self.rows)} rows, {len(missed)} missed" + "".join(f"\n  {name}" for name in missed))
        if path is not None:
            usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
            report = {
                "schema": SCHEMA,
                "machine": {"platform": platform.platform(), "cpus": usable, **(machine or {})},
                "versions": {
                    "python": platform.python_version(),
                    **{name: version(name) for name in packages},
                    **(versions or {}),
                },
                # JSON has no word for what is not a number.
                "rows": [{**r, "value": r["value"] if math.isfinite(r["value"]) else None} for r in self.rows],
            }
            path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        return 1 if missed else 0


def resident_mib() -> float:
    """Resident memory of this process; its largest so far where the system does not tell the present one."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
