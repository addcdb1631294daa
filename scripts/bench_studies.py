#!/usr/bin/env python3
"""Bench of the studies: time, agreement with the published figures, and whether calibrations find one minimum.

    bench_studies.py [--quick] [--images] [--json F]

The bench runs guestrin2006, blignaut2014 and conditions with E1 to E5 (--quick: E1 and E2, without conditions) as the
command does, with one process per processor. --images adds both replications with rendered images, with and without
sensor noise, at the scenes' samples per pixel; this takes minutes. Times are clock times and include the imports of the
processes. Their `must` is meant for two idle cores. The exit code is 1 if a `must` is missed.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from _bench import Report, Row, options_of, row
from eyerender.apps.study.literature import MODELS
from eyerender.apps.study.run import run_study


def measure_images(quick: bool) -> Iterator[Row]:
    """Both replications with both observers; by the clock, and what the processes took."""
    eyes, total = ("E1", "E2") if quick else MODELS, 0.0
    with tempfile.TemporaryDirectory() as place:
        for name in ("guestrin2006", "blignaut2014"):
            start, before = time.monotonic(), _processor_seconds()
            run_study(name, Path(place) / name, observer="both", eyes=eyes, workers=None, progress=_tell)
            seconds = time.monotonic() - start
            total += seconds
            yield row(f"{name} with images, {len(eyes)} models", seconds, "s")
            yield row(f"{name} with images, processor time", _processor_seconds() - before, "s")
    yield row("both replications with images", total, "s", 1200)


def _processor_seconds() -> float:
    """Of this process and of those that it has waited for."""
    return sum(
        t.ru_utime + t.ru_stime for t in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def _tell(done: int, total: int, note: str) -> None:
    print(f"\r{done}/{total} {note:<70}", end="" if done < total else "\n", file=sys.stderr, flush=True)


def measure(quick: bool) -> Iterator[Row]:
    """All rows of the analytic studies, as they are measured."""
    eyes = ("E1", "E2") if quick else MODELS
    names = ("guestrin2006", "blignaut2014") if quick else ("guestrin2006", "blignaut2014", "conditions")
    workers = len(os.sched_getaffinity(0))
    seconds, found, summaries = {}, {}, {}
    with tempfile.TemporaryDirectory() as place:
        for name in names:
            start = time.monotonic()
            summaries[name] = run_study(name, Path(place) / name, eyes=eyes, workers=workers)
            seconds[name] = time.monotonic() - start
            yield row(f"{name}, {len(eyes)} models, {workers} processes", seconds[name], "s")
            if name == "blignaut2014" and not quick:
                yield row("both replications, analytic", sum(seconds.values()), "s", 20)
            found[name] = json.loads((Path(place) / name / "findings.json").read_text(encoding="utf-8"))["findings"]
    values = {(f["id"], f["protocol"], f["rule"]): f["value"] for f in found["guestrin2006"]}
    farthest = next(v for k, v in values.items() if k[0] == "P1")
    yield row("published means of E1 to E4, largest difference from the paper", farthest, "deg", 0.02, 0.0055)
    spread = [c["restarts"] for c in summaries["guestrin2006"]["calibrations"]]
    missed = sum(s["count"] - s["within_1e-4_of_the_lowest_cost"] for s in spread)
    yield row(f"random starts of {sum(s['count'] for s in spread)} that end elsewhere", missed, "count", 0)
    widest = max(s["h1_mean_deg"]["max"] - s["h1_mean_deg"]["min"] for s in spread)
    yield row("widest spread of the H1 error over 20 starts", widest, "deg", 1e-3)
    if not quick:
        low = [v for k, v in values.items() if k[0] == "P2" and k[2].startswith("E5-published")]
        yield row("published variants of E5 that stay below 11 deg", sum(v <= 11 for v in low), "count", 0)
        lost = [
            e for m in summaries["conditions"]["models"] for e in m["sensitivity"] for t in e.values()
            if isinstance(t, dict) and t["reason"]
        ]  # fmt: skip
        yield row("changed eyes without a result", len(lost), "count", 0)


def main() -> int:
    """Measure, print, write."""
    parser = options_of(__doc__, "two eye models, without the conditions")
    parser.add_argument("--images", action="store_true", help="also with rendered images")
    options = parser.parse_args()
    report = Report()
    report.extend(measure(options.quick))
    if options.images:
        report.extend(measure_images(options.quick))
    return report.finish(options.json, ("eyerender", "numpy", "scipy", "matplotlib"))


if __name__ == "__main__":
    sys.exit(main())
