#!/usr/bin/env python3
"""Bench of measured corneas: how exact expansions are, and what they cost against conics.

    bench_corneas.py [--quick] [--json F]

All times are CPU times of the process, the best of several runs in turns. E4 has its two corneal surfaces as conics, as
Zernike terms of order 14, and as grids. The exit code is 1 if a `must` is missed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from _bench import Report, Row, options_of, row, single_threaded

single_threaded()
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from eyerender.analytic.features import features
from eyerender.backends.choose import choose_backend
from eyerender.eye.catalogue import load_eye
from eyerender.eye.model import EyeModel
from eyerender.eye.parts import PlacedSpec
from eyerender.eye.pose import Poses
from eyerender.eye.spec import EyeSpec
from eyerender.eye.surfaces import surface_of
from eyerender.optics.surfaces_measured import GridSurface, ZernikeSurface
from tests.support.corneas import conic_depth, eye_with, grid_of, keratoconus, zernike_of

COUNT = 1000
KINDS = ("conic", "zernike", "grid")


def eye_as(kind: str) -> EyeModel:
    """E4 with both corneal surfaces as conics, as expansions on 5 mm, or as grids."""
    data = load_eye("E4").to_mapping()
    for surface in data["cornea"] if kind != "conic" else ():
        shape = surface["shape"]
        depth = partial(conic_depth, radius_mm=shape["radius_mm"], conic_constant=shape.get("conic_constant", 0.0))
        surface["shape"] = (zernike_of(depth, 5.0, 14) if kind == "zernike" else grid_of(depth, 4.5)).to_mapping()
    return EyeSpec.from_mapping(data).build(pupil_diameter_mm=4.0)


def others(kind: str, count: int) -> list[EyeModel]:
    """Different eyes of one kind, whose fronts differ by nanometres."""
    eye, rng = eye_as(kind), np.random.default_rng(0)
    front: Any = eye.front[0]

    def changed() -> Any:
        if isinstance(front, ZernikeSurface):
            noise = rng.normal(size=front.coefficients_mm.shape) * 1e-6
            return replace(front, coefficients_mm=front.coefficients_mm + noise, table=np.zeros(0))
        if isinstance(front, GridSurface):
            return replace(front, table=front.table + rng.normal(size=front.table.shape) * 1e-6)
        return type(front).conic(7.72 + 1e-6 * rng.normal(), -0.26)

    return [replace(eye, front=(changed(), eye.front[1])) for _ in range(count)]


def in_turns(works: dict[str, Callable[[], Any]], runs: int) -> dict[str, float]:
    """Best CPU seconds of each, run one after the other several times."""
    best = dict.fromkeys(works, np.inf)
    for _ in range(runs):
        for name, work in works.items():
            start = time.process_time()
            work()
            best[name] = min(best[name], time.process_time() - start)
    return best


def exactness() -> Iterator[Row]:
    """Expansions of spheres, and features of a conic as an expansion."""
    rng = np.random.default_rng(1)
    r, angle = 3.25 * np.sqrt(rng.uniform(size=5000)), rng.uniform(0.0, 2.0 * np.pi, 5000)
    y, z = r * np.cos(angle), r * np.sin(angle)
    for radius in (6.5, 7.8):
        depth = partial(conic_depth, radius_mm=radius, conic_constant=0.0)
        surface = surface_of(PlacedSpec(shape=zernike_of(depth, 3.25, 14)))
        away = np.abs(surface.local_sag(y, z) + conic_depth(y, z, radius, 0.0)).max()
        yield row(f"sphere of {radius:g} mm, order 14 on 3.25 mm", away, "mm", 1e-9)
    grid = surface_of(PlacedSpec(shape=grid_of(keratoconus)))
    near = r < 3.2
    truth = -keratoconus(y, z) + keratoconus(0.0, 0.0)
    yield row("cone on a grid of 0.25 mm", np.abs(grid.local_sag(y, z) - truth)[near].max(), "mm", 1e-6)
    exact = seen([eye_as("conic")], 200)
    for kind in KINDS[1:]:
        found = seen([eye_as(kind)], 200)
        yield row(f"conic as {kind}: pupil", np.nanmax(np.abs(exact.points_px - found.points_px)), "px", 1e-4)
        yield row(f"conic as {kind}: glint", np.nanmax(np.abs(exact.glints_px - found.glints_px)), "px", 1e-4)
        yield row(f"conic as {kind}: residual", np.nanmax(found.point_residual_mm), "mm", 1e-9)


def seen(eyes: list[EyeModel], count: int) -> Any:
    """Features of eyes in turn, in a remote camera with three lamps."""
    from tests.eye.test_corneas import LIGHTS, camera

    rng = np.random.default_rng(4)
    poses = Poses.from_degrees(rng.uniform(-20, 20, count), rng.uniform(-15, 15, count))
    which = np.arange(count) % len(eyes)
    return features(eyes, which, poses, np.zeros((count, 3)), [camera()], np.zeros(count, int), LIGHTS)


def batches(runs: int) -> Iterator[Row]:
    """A thousand different eyes in one batch, against one eye a thousand times."""
    eyes = {kind: others(kind, COUNT) for kind in KINDS}
    works: dict[str, Callable[[], Any]] = {}
    for kind in KINDS:
        works[f"{kind}, different"] = partial(seen, eyes[kind], COUNT)
        works[f"{kind}, same"] = partial(seen, eyes[kind][:1], COUNT)
    cost = in_turns(works, runs)
    for kind, must in zip(KINDS, (None, 2.0, 4.0), strict=True):
        yield row(f"{kind}: one eye", cost[f"{kind}, same"] / COUNT * 1e6, "us/eye")
        yield row(f"{kind}: different / same", cost[f"{kind}, different"] / cost[f"{kind}, same"], "ratio", must)


def frames(backend: Any, runs: int) -> Iterator[Row]:
    """Rendered frames against those of conics, what a new subject costs, and its kernels."""
    from eyerender.rendering.records.lattice import lattice
    from eyerender.rendering.renderer import Renderer
    from tests.rendering.test_renderer import kernels
    from tests.support.render_rigs import head_rig, job_of, remote_rig

    renderer = Renderer(backend, spp=16)
    for name, rig in (("remote, 1 LED", remote_rig()), ("headset, 6 LEDs", head_rig())):
        jobs = {kind: job_of(eye_as(kind), rig, rig.window(640, 480), labels=False) for kind in KINDS}
        jobs["front alone"] = replace(
            jobs["conic"],
            eye=replace(jobs["conic"].eye, front=(jobs["zernike"].eye.front[0], jobs["conic"].eye.front[1])),
        )
        for job in jobs.values():
            renderer.render(job)
        cost = in_turns({kind: partial(renderer.render, job) for kind, job in jobs.items()}, runs)
        for kind in ("front alone", "zernike", "grid"):
            yield row(f"{name}: {kind} / conic, CPU", cost[kind] / cost["conic"], "ratio", 1.6)
        yield row(f"{name}: conic", cost["conic"], "s")
    first, *rest = (
        job_of(eye_with(shape).build(), head_rig(), (200, 150, 64, 48))
        for shape in (
            grid_of(keratoconus),
            grid_of(conic_depth, 5.0, 0.2),
            zernike_of(keratoconus, 4.5, 12),
            zernike_of(conic_depth, 3.25, 8),
        )
    )
    known = kernels(renderer, [first])
    yield row("new kernels of three more subjects", len(kernels(renderer, rest) - known), "kernels", 0)
    fresh = others("zernike", 5)
    cost = in_turns({"table": lambda: [lattice.__wrapped__(eye.front[0], 5.85) for eye in fresh]}, 3)
    yield row("table of a new surface", cost["table"] / 5 * 1e3, "ms")


def main() -> int:
    """Measure, print, write."""
    options = options_of(__doc__, "fewer runs").parse_args()
    backend = choose_backend("llvm", threads=1)
    report = Report()
    runs = 3 if options.quick else 8
    report.extend(exactness())
    report.extend(batches(runs))
    report.extend(frames(backend, runs))
    return report.finish(options.json, ("eyerender", "numpy", "scipy", "mitsuba", "drjit"))


if __name__ == "__main__":
    sys.exit(main())
