#!/usr/bin/env python3
"""Bench of the analytic features: time per frame and eye, its growth, memory, residuals.

    bench_features.py [--quick] [--json F]

The bench uses the Blignaut scene: both eyes, random targets on its screen, fixation by chief ray, 30 boundary points
with their ellipse, the centre of the stop and a glint. Times are CPU times of the process, the best of several runs,
so other work on the machine has little influence. No matrix product here is large enough to be spread over cores. The
exit code is 1 if a `must` is missed.
"""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import fields

import numpy as np

from _bench import Report, Row, options_of, row
from eyerender.analytic.features import Features, features
from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.eye.catalogue import load_eye
from eyerender.eye.fixation import fixations
from eyerender.scene import Scene, load_scene
from eyerender.scene.people import Population
from eyerender.scene.spec import SceneSpec

EYES = ("E2", "E4", "E5")
# Best published time of a Python simulator of such eyes, ms a frame without fixation; quoted, not measured here.
QUOTED_MS = (5.4, 6.8)


def observe(name: str, frames: int, seed: int = 0) -> tuple[float, Features, float]:
    """(CPU seconds, features, largest fixation residual) of `frames` frames of both eyes."""
    scene = load_scene("blignaut2014")
    screen = scene.rig.screen
    assert screen is not None
    rng = np.random.default_rng(seed)
    half = np.array(screen.size_mm) / 2
    target = np.repeat(screen.world(rng.uniform(-half, half, (frames, 2))), 2, axis=0)
    which = np.tile([0, 1], frames)
    position = np.stack([scene.eye_position_mm(side) for side in ("right", "left")])[which]
    lights = np.array([light.position_mm for light in scene.rig.lights])
    eyes = [load_eye(name).build(eye=side) for side in ("right", "left")]
    start = time.process_time()
    found = fixations(eyes, which, target, position)
    seen = features(eyes, which, found.poses, position, scene.rig.cameras, np.zeros(2 * frames, dtype=int), lights)
    return time.process_time() - start, seen, float(found.residual_mm.max())


def cost_us(name: str, frames: int, runs: int) -> float:
    """Microseconds a frame and eye, best of `runs`."""
    return min(observe(name, frames, seed)[0] for seed in range(runs)) / (2 * frames) * 1e6


def measure(quick: bool) -> Iterator[Row]:
    """All rows, as they are measured."""
    frames, runs, most = (2_000, 4, 10_000) if quick else (10_000, 8, 100_000)
    for name in EYES:
        observe(name, 100)
    cost = {name: cost_us(name, frames, runs) for name in EYES}
    yield row("E2, fixation + 30 points + glint", cost["E2"], "us/frame and eye", 25.0, 10.0)
    yield row("E4 / E2", cost["E4"] / cost["E2"], "ratio", 2.0)
    yield row("E5 / E2", cost["E5"] / cost["E2"], "ratio", 3.0)
    yield row("E4", cost["E4"], "us/frame and eye")
    yield row("E5", cost["E5"], "us/frame and eye")
    growth: dict[int, float] = {}
    for _ in range(5):
        # In turns, so that a busy spell of the machine falls on all sizes alike.
        for n in sorted({1_000, 10_000, most}):
            growth[n] = min(growth.get(n, np.inf), cost_us("E2", n, max(1, 20_000 // n)))
    for n, c in growth.items():
        yield row(f"E2, {n} frames", c, "us/frame and eye")
    spread = max(growth.values()) / min(growth.values())
    yield row(f"E2, slowest / fastest, 1000 to {most} frames", spread, "ratio", 1.2)
    yield row("1000 different eyes / the same eye 1000 times", different_eyes(1_000, runs), "ratio", 2.0)
    yield row("8 LEDs, behind spectacles / without", behind_spectacles(runs), "ratio", 8.0, 4.0)
    yield memory("E2")
    yield memory("E5")
    for name in EYES:
        _, seen, fixation = observe(name, 1_000, seed=99)
        bad = int(np.count_nonzero(seen.point_status) + np.count_nonzero(seen.glint_status))
        yield row(f"{name}, points and glints without a ray", bad, "count", 0)
        yield row(f"{name}, worst residual of a boundary point", seen.point_residual_mm.max(), "mm", 1e-9)
        yield row(f"{name}, worst residual of a glint", seen.glint_residual_mm.max(), "mm", 1e-9)
        yield row(f"{name}, worst residual of a fixation", fixation, "mm", 1e-6)
    for quoted in QUOTED_MS:
        yield row(f"quoted {quoted} ms of another Python simulator / E2", quoted * 1e3 / cost["E2"], "ratio")


def different_eyes(count: int, runs: int) -> float:
    """Cost of fixation and features of `count` drawn eyes over that of one of them as often; best of runs in turns."""
    population, eyes = Population("adults"), []
    for k in itertools.count():
        with contextlib.suppress(InputError):  # physics refuses a few people
            eyes.append(population.person(k).eye("right").build())
        if len(eyes) == count:
            break
    scene = load_scene("blignaut2014")
    rng = np.random.default_rng(0)
    target = np.column_stack([np.full(count, 600.0), rng.uniform(-200, 200, (count, 2))])
    place, zero = np.zeros((count, 3)), np.zeros(count, dtype=int)
    lights = np.array([light.position_mm for light in scene.rig.lights])
    best: dict[str, float] = {}
    for _ in range(2 * runs):
        for name, which in (("same", zero), ("different", np.arange(count))):
            start = time.process_time()
            found = fixations(eyes, which, target, place)
            features(eyes, which, found.poses, place, scene.rig.cameras, zero, lights)
            best[name] = min(best.get(name, np.inf), time.process_time() - start)
    return best["different"] / best["same"]


def behind_spectacles(runs: int) -> float:
    """Cost of poses and features of 2,000 frames and eyes with eight LEDs behind lenses of -4 D over that without."""
    data = load_scene("blignaut2014").spec.to_mapping()
    angle = 2.0 * np.pi * np.arange(8) / 8.0
    lights = np.column_stack([np.full(8, 560.0), 150.0 * np.cos(angle), 100.0 * np.sin(angle) - 250.0]).tolist()
    data["rig"]["lights"] = [{"position_mm": place, "radius_mm": 2.5} for place in lights]
    data["targets"] = {"grid": [40, 25]}
    scenes = []
    for lens in (None, {"sphere_d": -4.0}):
        data["subject"]["spectacles"] = lens
        scenes.append(Scene.of(SceneSpec.from_mapping(data)))
    best = [np.inf, np.inf]
    for _ in range(runs + 1):  # in turns
        for k, scene in enumerate(scenes):
            start = time.process_time()
            trace(scene)
            best[k] = min(best[k], time.process_time() - start)
    return best[1] / best[0]


def memory(name: str) -> Row:
    """How peak memory grows with the batch, over how the result does: little above 1 where chunks bound the work."""
    peaks = []
    for count in (4_000, 12_000):
        tracemalloc.start()
        _, seen, _ = observe(name, count)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        kept = sum(getattr(seen, f.name).nbytes for f in fields(seen))
        peaks.append((peak, kept))
    # Targets and poses grow with the batch too; they are smaller than the result.
    growth = (peaks[1][0] - peaks[0][0]) / (peaks[1][1] - peaks[0][1])
    return row(f"{name}, growth of peak memory / growth of the result", growth, "ratio", 1.5)


def main() -> int:
    """Measure, print, write."""
    options = options_of(__doc__, "fewer frames and runs").parse_args()
    report = Report()
    report.extend(measure(options.quick))
    return report.finish(options.json, ("eyerender", "numpy", "scipy"))


if __name__ == "__main__":
    sys.exit(main())
