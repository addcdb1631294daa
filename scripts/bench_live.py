#!/usr/bin/env python3
"""Bench of the live page in a headless Chromium: time from a slider to the picture, and memory of the server.

    bench_live.py [--quick] [--json F] [--backend llvm|cuda]

It needs the extra `live`, Selenium and Chromium: .venv-live/bin/python scripts/bench_live.py, after scripts/test-live
has made that environment. For the scenes `headset` and `desktop_tracker` it moves the sliders of gaze, pupil, lids and
an LED by their keys, one step after the other. The time runs in the browser, from the key until the picture of the new
scene is shown. Chromium draws the 3-D view without a graphics card here, on the same cores, which is slower than on a
usual machine. Memory is that of the server after 200 and after 1000 updates, and after further tabs were closed.
The exit code is 1 if a `must` is missed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from itertools import islice
from typing import Any

import numpy as np

from _bench import Report, Row, options_of, row
from _browser import WATCH, chromium, latency_s, live_server, pictured, until

SLIDERS = ("Azimuth, to the subject's left", "Elevation, up", "Pupil", "Lid opening", "y, to the subject's left")
KEYS = ("ArrowLeft",) * 3 + ("ArrowRight",) * 3
UPDATES, WARM, EACH = 1000, 200, 120


def moves() -> Iterable[tuple[str, str]]:
    """Steps of sliders, forth and back."""
    while True:
        for name in SLIDERS:
            for key in KEYS:
                yield name, key


def opened(driver: Any, address: str) -> None:
    """Open the page and wait for its first picture."""
    driver.get(address)
    until(lambda: pictured(driver), 120)
    driver.execute_script(WATCH)
    time.sleep(3)


def rendering_s(driver: Any) -> float:
    """Time that the rendering of the shown picture took, from the line below it."""
    line = driver.execute_script("return document.querySelector('.status').textContent")
    return int(line.partition("rendered in ")[2].split()[0]) / 1000


def latencies(scene: str, backend: str, count: int) -> Iterable[Row]:
    """Rows of one scene."""
    with live_server(scene, "--backend", backend) as server, chromium() as driver:
        opened(driver, server.address)
        steps = iter(moves())
        for name, key in islice(steps, 12):
            latency_s(driver, name, key)
        pairs = [(latency_s(driver, name, key), rendering_s(driver)) for name, key in islice(steps, count)]
        times, rendering = np.array(pairs).T
        yield row(f"{scene}: slider to picture, median", float(np.median(times)), "s", aim=0.3)
        yield row(f"{scene}: slider to picture, 95 %", float(np.percentile(times, 95)), "s", aim=0.5)
        yield row(
            f"{scene}: the same, over the time of the rendering", float(np.median(times / rendering)), "", aim=1.5
        )


def memory(scene: str, backend: str, updates: int, warm: int) -> Iterable[Row]:
    """Growth of the server's memory with updates, and what a closed tab leaves."""
    with live_server(scene, "--backend", backend) as server, chromium() as driver:
        opened(driver, server.address)
        steps = iter(moves())
        for name, key in islice(steps, warm):
            latency_s(driver, name, key)
        before = server.memory_mb()
        for name, key in islice(steps, updates - warm):
            latency_s(driver, name, key)
        after = server.memory_mb()
        yield row(f"{scene}: memory after {warm} updates", before, "MB")
        yield row(f"{scene}: memory after {updates} updates", after, "MB")
        yield row(f"{scene}: growth per 100 updates", (after - before) / (updates - warm) * 100, "MB", 5)
        for _ in range(5):
            first = driver.current_window_handle
            driver.switch_to.new_window("tab")
            opened(driver, server.address)
            driver.close()
            driver.switch_to.window(first)
        time.sleep(15)
        yield row(f"{scene}: growth with 5 further tabs, closed again", server.memory_mb() - after, "MB", 60)


def main() -> int:
    """Measure, print, write."""
    parser = options_of(__doc__, "fewer updates")
    parser.add_argument("--backend", choices=["auto", "llvm", "cuda"], default="auto")
    options = parser.parse_args()
    report = Report()
    for scene in ("headset", "desktop_tracker"):
        report.extend(latencies(scene, options.backend, 20 if options.quick else EACH))
    updates = (100, 40) if options.quick else (UPDATES, WARM)
    report.extend(memory("headset", options.backend, *updates))
    return report.finish(options.json, ("eyerender", "nicegui", "mitsuba", "drjit"))


if __name__ == "__main__":
    sys.exit(main())
