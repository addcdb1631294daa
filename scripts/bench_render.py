#!/usr/bin/env python3
"""Bench of the renderer: physics against independent oracles, cost, first frames, new subjects, memory, determinism.

    bench_render.py [--quick] [--json F] [--backend llvm|cuda] [--threads N] [--cycles PYTHON]

Limits apply to ratios and counts; seconds are only reported. Times are CPU times of the process, so other work on the
machine has little influence. --quick takes fewer samples and poses with the same limits, but the standard error of the
oracle then has no limit. The exit code is 1 if a `must` is missed. Blender's Cycles renders the same bare eye if the
Python given by --cycles has the package `bpy`.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from _bench import Report, Row, options_of, resident_mib, row, single_threaded

single_threaded()
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np

from eyerender.backends.choose import choose_backend

MODELS = ("E1", "E2", "E3", "E4", "E5")


def cpu_of(work: Callable[[], Any], runs: int) -> tuple[float, float]:
    """(CPU seconds, wall seconds) of one call, best of `runs`."""
    best = [np.inf, np.inf]
    for _ in range(runs):
        c, w = time.process_time(), time.perf_counter()
        work()
        best = [min(best[0], time.process_time() - c), min(best[1], time.perf_counter() - w)]
    return best[0], best[1]


class Bench:
    """The measurements; `small` for --quick."""

    def __init__(self, backend: Any, small: bool, cycles: str = sys.executable) -> None:
        from eyerender.rendering.renderer import Renderer
        from tests.support import render_rigs

        self.rigs, self.small = render_rigs, small
        self.renderer = Renderer(backend, spp=16)
        self.backend, self.cycles_python = backend, cycles

    def rows(self) -> Iterable[Row]:
        """All rows, as they are measured."""
        for part in (
            self.iris_against_path, self.iris_against_light_tracer, self.noise, self.glint_centroids, self.large_disc,
            self.pupil_outline, self.cost, self.cycles, self.surfaces_cost, self.region_cost, self.host_time,
            self.region_noise, self.subjects, self.first_frames, self.recompiles, self.fixed_cost, self.memory,
            self.determinism,
        ):  # fmt: skip
            yield from part()

    def iris_against_path(self) -> Iterable[Row]:
        """Radiance of E2's iris under two LEDs of 100 mm at 300 mm, against the stock path integrator on the meshes.

        The lamps stand 65 degrees off the axis; pixels that show a lamp's mirror image are left out on both sides.
        """
        import drjit as dr
        import mitsuba as mi

        from eyerender.base.arrays import frozen
        from eyerender.rendering.hits.primary import first_hit
        from eyerender.rendering.integrator.sampling import Pixels, camera_ray
        from eyerender.rig.camera import Camera
        from eyerender.rig.light import Lamp
        from tests.support.render_oracles import RINGS_MM

        rigs, n = self.rigs, 72
        eye = rigs.eye_of("E2")
        camera = Camera(
            resolution_px=(n, n),
            position_mm=(600.0, 0.0, 0.0),
            look_at_mm=(0.0, 0.0, 0.0),
            focal_length_px=600 * n / 11.4,
        ).build()
        lights = []
        for side in (1, -1):
            a = np.radians(65.0)
            place = 300 * np.array([np.cos(a), side * np.sin(a), 0.0])
            lights.append(
                Lamp(
                    position_mm=frozen(place),
                    axis=frozen(-place / 300),
                    radius_mm=100.0,
                    intensity_mw_sr=1000.0,
                    lobe_exponent=1.0,
                )
            )
        black = rigs.BLACK.model_copy(update={"iris_albedo": 0.5, "iris_contrast": 0.0})
        rig = rigs.LampRig(camera, tuple(lights))
        job = rigs.job_of(eye, rig, (0, 0, n, n), look=black)
        shown, _ = self.renderer.bind(job)
        values = shown.frame
        u, v = Pixels.of(job.window).at(dr.arange(mi.UInt32, n * n))
        o, d, _ = camera_ray(values, mi.Float(u), mi.Float(v))
        view = first_hit(values, o, d, True)
        inner = view.inner.numpy().T
        rho = np.hypot(inner[:, 1], inner[:, 2]).reshape(n, n)
        cornea = view.cornea.numpy().astype(bool).reshape(n, n)
        first = view.point.numpy().T.astype(float)
        ray = camera.rays(np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2))
        N = eye.front[0].normal(first)
        w = ray - 2 * np.sum(ray * N, axis=1, keepdims=True) * N
        glint = np.zeros(n * n, bool)
        for lamp in lights:
            s = ((lamp.position_mm - first) @ lamp.axis) / (w @ lamp.axis)
            glint |= (np.linalg.norm(first + s[:, None] * w - lamp.position_mm, axis=1) < 130) & (s > 0)
        mine = self.renderer.radiance(job, spp=512)
        cos4 = (ray @ camera.axis).reshape(n, n) ** 4

        with tempfile.TemporaryDirectory() as folder:
            scene = self._stock(job, folder, max_depth=24, rings=256, sectors=512)
            spp = 512 if self.small else 2048
            runs = 4 if self.small else 32
            stock = np.array([np.array(mi.render(scene, seed=k, spp=spp))[..., 0] for k in range(runs)], dtype=float)
        for name, (p, q) in zip(("inner", "mid", "outer"), RINGS_MM, strict=True):
            ring = cornea & (rho >= p) & (rho < q) & ~glint.reshape(n, n)
            each = stock[:, ring].mean(axis=1)
            truth, error = each.mean(), each.std(ddof=1) / np.sqrt(runs) / each.mean()
            difference = abs((mine / cos4)[ring].mean() / truth - 1)
            yield row(f"E2 iris {name}: oracle's standard error", 100 * error, "%", None if self.small else 0.1)
            yield row(f"E2 iris {name}: difference to path, depth 24", 100 * difference, "%", 0.5 + 200 * error)

    def _stock(self, job: Any, folder: str, *, max_depth: int, rings: int = 48, sectors: int = 128) -> Any:
        """The exported job as stock Mitsuba loads it."""
        import mitsuba as mi

        from eyerender.rendering.output.export import export_scene

        path = export_scene(job, folder, spp=16, max_depth=max_depth, rings=rings, sectors=sectors)
        return mi.load_file(str(path))

    def iris_against_light_tracer(self) -> Iterable[Row]:
        """Irradiance of the iris of E4 and E5 by a point lamp, against flux counted by a forward tracer in float64."""
        from eyerender.base.arrays import frozen
        from eyerender.rig.light import Lamp
        from tests.support.render_oracles import RINGS_MM, flux_on_rings, ring_points

        rigs = self.rigs
        for model in ("E4", "E5"):
            eye = rigs.eye_of(model)
            for where, place in (("remote", (500.0, 0.0, -150.0)), ("head-mounted", (30.0, -6.0, -14.0))):
                lamp = Lamp(
                    position_mm=frozen(place),
                    axis=frozen([-1.0, 0, 0]),
                    radius_mm=0.0,
                    intensity_mw_sr=100.0,
                    lobe_exponent=0.0,
                )
                rig = rigs.LampRig(rigs.remote_rig().camera, (lamp,))
                plain = rigs.PLAIN.model_copy(update={"limbus_width_mm": 0.0})
                job = rigs.job_of(eye, rig, (0, 0, 16, 16), look=plain)
                parts = [flux_on_rings(eye, np.array(place) + 1e-4 * k, 100.0, 1500) for k in range(4)]
                truth = np.mean(parts, axis=0) * abs(eye.stop.normal[0])
                error = np.std(parts, axis=0, ddof=1) / np.sqrt(4) / np.mean(parts, axis=0)
                mine = np.array(
                    [rigs.iris_irradiance(self.renderer, job, ring_points(eye, p, q)).mean() for p, q in RINGS_MM]
                )
                worst = int(np.argmax(np.abs(mine / truth - 1) - 2 * error))
                yield row(f"{model} iris {where}: tracer's standard error", 100 * error.max(), "%", 0.1)
                yield row(
                    f"{model} iris {where}: largest difference of a ring", 100 * abs(mine / truth - 1)[worst], "%",
                    0.2 + 200 * error[worst],
                )  # fmt: skip

    def noise(self) -> Iterable[Row]:
        """Relative noise of a uniform iris at 1 spp: pixels over the same pixels at 256 spp, less a smooth surface.

        At 1 spp every pixel is sampled at the same place; what this shifts is smooth, and no noise.
        """
        rigs = self.rigs
        rig = rigs.remote_rig()
        first_hit = rigs.PLAIN.model_copy(update={"limbus_width_mm": 0.0})
        job = rigs.job_of(rigs.eye_of("E2"), rig, rig.window(96, 96), look=first_hit)
        part = self.renderer.labels(job).part
        iris = part == 2
        for axis in (0, 1):
            for shift in (1, -1, 2, -2):
                iris &= np.roll(part, shift, axis) == 2
        quotient = self.renderer.radiance(job, spp=1) / self.renderer.radiance(job, spp=256)
        v, u = (c[iris] / 48 - 1 for c in np.mgrid[:96, :96])
        basis = np.stack([u**i * v**j for i in range(5) for j in range(5 - i)], axis=1)
        rest = quotient[iris] - basis @ np.linalg.lstsq(basis, quotient[iris], rcond=None)[0]
        yield row("noise of a uniform iris at 1 spp, remote", 100 * rest.std(), "%", 0.5)

    def glint_centroids(self) -> Iterable[Row]:
        """Centroids of rendered glints of point lamps against Fermat's principle in float64."""
        from tests.support.render_oracles import centroid, mirror_pixel

        rigs = self.rigs
        poses = 10 if self.small else 200
        for name in ("remote", "head"):
            errors = []
            for model in MODELS:
                rng = np.random.default_rng(MODELS.index(model))
                eye, rig = rigs.eye_of(model), rigs.RIGS[name](radius_mm=0.0)
                done = 0
                while done < poses:
                    pose = (rng.uniform(-30, 30), rng.uniform(-25, 25))
                    lamp = rig.lights[rng.integers(len(rig.lights))]
                    job = rigs.job_of(eye, rig, rig.window(32, 32), pose, look=rigs.BLACK, lights=(lamp,), labels=False)
                    xy, rho = mirror_pixel(eye, job, lamp.position_mm)
                    if rho > eye.limbus_radius_mm - 0.05:
                        continue
                    job = replace(job, window=rig.window(32, 32, np.round(xy)))
                    image = self.renderer.render(job, spp=1).irradiance
                    errors.append(np.linalg.norm(centroid(image, job.window) - xy))
                    done += 1
            yield row(f"glint centroid E1..E5 {name}: median of {len(errors)}", np.median(errors), "px", 0.002)
            yield row(f"glint centroid E1..E5 {name}: maximum", np.max(errors), "px", 0.01)

    def large_disc(self) -> Iterable[Row]:
        """Flux and place of the glint of a large disc LED against stock path on the exported scene."""
        import mitsuba as mi

        from tests.support.render_oracles import centroid

        rigs = self.rigs
        rig = rigs.head_rig(radius_mm=4.0, count=1)
        job = rigs.job_of(rigs.eye_of("E2"), rig, (0, 0, 8, 8), (4.0, -3.0), look=rigs.BLACK, labels=False)
        xy = self.renderer.render(job, spp=1).glints.xy_px[0]
        window = rig.window(28, 28, np.round(xy))
        job = replace(job, window=window)
        mine = self.renderer.render(job, spp=1)
        unit = 1e3 * np.pi * job.sensor.lens_transmission / (4 * job.sensor.f_number**2)
        # The oracle's film has pixels an eighth of the size: the centroid of a sharp disc on coarse pixels is off by
        # hundredths of a pixel, and it has no point-spread function that would mend this.
        fine = 8
        K = np.array(job.camera.K)
        K[:2] *= fine
        K[:2, 2] += 0.5 * (fine - 1)
        camera = replace(job.camera, K=K, resolution_px=tuple(fine * r for r in job.camera.resolution_px))
        zoomed = replace(job, camera=camera, window=tuple(fine * x for x in window))
        v, u = np.mgrid[: fine * window[3], : fine * window[2]]
        pixels = np.stack([u + zoomed.window[0], v + zoomed.window[1]], axis=-1).reshape(-1, 2)
        cos4 = ((camera.rays(pixels) @ camera.axis) ** 4).reshape(u.shape)
        with tempfile.TemporaryDirectory() as folder:
            scene = self._stock(zoomed, folder, max_depth=6, rings=256, sectors=512)  # through the film and back
            spp = 512 if self.small else 2048
            image = np.array(mi.render(scene, spp=spp))[..., 0].astype(float) * cos4 * unit / fine**2
        place = (centroid(image, zoomed.window) - 0.5 * (fine - 1)) / fine
        flux = image.sum()
        yield row("large disc: flux against path", 100 * abs(mine.irradiance.sum(dtype=float) / flux - 1), "%", 1.0)
        away = float(np.linalg.norm(centroid(mine.irradiance, window) - place))
        yield row("large disc: centroid against path", away, "px", 0.02)

    def pupil_outline(self) -> Iterable[Row]:
        """RMS of the smooth contour (12 harmonics) of rendered pupils at 64 spp against the refracted margin."""
        from tests.support.render_oracles import contour_error, outline

        rigs = self.rigs
        dark = rigs.PLAIN.model_copy(update={"pupil_albedo": 0.0})
        grey = rigs.PLAIN.model_copy(update={"pupil_albedo": rigs.PLAIN.iris_albedo})
        for name, size in (("remote", 48), ("head", 128)):
            errors = []
            for model in MODELS if not self.small else ("E2", "E5"):
                for pose in ((0.0, 0.0), (9.0, -6.0), (-14.0, 8.0)):
                    eye, rig = rigs.eye_of(model), rigs.RIGS[name]()
                    polygon = outline(rigs.job_of(eye, rig, (0, 0, 1, 1), pose))
                    window = rig.window(size, size, polygon.mean(axis=0))
                    a, b = (
                        self.renderer.radiance(rigs.job_of(eye, rig, window, pose, look=k), spp=64)
                        for k in (dark, grey)
                    )
                    errors.append(contour_error(1 - a / b, polygon, window))
            yield row(f"pupil outline {name}: largest of {len(errors)}", max(errors), "px rms", 0.01)

    def _full_frame(self, model: str, lamps: int = 8) -> Any:
        """Job of a bare eye that fills 640 x 480 px of a head-mounted camera."""
        rig = self.rigs.head_rig(count=lamps)
        return self.rigs.job_of(self.rigs.eye_of(model), rig, rig.window(640, 480), (5.0, 3.0), labels=False)

    def _scene_job(self, name: str, row_: int, **image: Any) -> Any:
        """Job of a row of a shipped scene."""
        import yaml

        from eyerender.imaging.capture import render_job
        from eyerender.scene import Scene
        from eyerender.scene.spec import SceneSpec

        path = ROOT / "scenes" / f"{name}.yaml"
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        data["image"] = {**data.get("image", {}), **image}
        return render_job(Scene.of(SceneSpec.from_mapping(data, source=str(path)), source=str(path)).frames(), row_)

    @staticmethod
    def _turned(job: Any, k: int) -> Any:
        """The same job with the eye in its k-th pose."""
        from eyerender.eye.pose import Poses, rigid_motion

        M, t = rigid_motion(Poses.from_degrees([12 * np.sin(1.7 * k)], [7 * np.cos(2.3 * k)]), job.eye)
        return replace(job, M=M[0], t=t[0] + job.anchor_mm, apex_mm=job.anchor_mm)

    def _in_turns(self, works: dict[str, Callable[[int], Any]]) -> dict[str, tuple[float, float]]:
        """Median (CPU, wall) seconds of works that take turns, after one call of each."""
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
        for k in range(4 if self.small else 10):
            for name, work in works.items():
                c, w = time.process_time(), time.perf_counter()
                work(k)
                if k:
                    times[name].append((time.process_time() - c, time.perf_counter() - w))
        return {name: tuple(float(x) for x in np.median(found, axis=0)) for name, found in times.items()}  # type: ignore[misc]

    def cost(self) -> Iterable[Row]:
        """CPU time of eyes that fill the frame (640 x 480, 8 LEDs, 16 samples), a new pose in each frame.

        Stock `path` renders the exported scene of E2 at unlimited depth; three coherent Embree rays per sample are
        what a mesh of the cornea would add.
        """
        import drjit as dr
        import mitsuba as mi

        jobs = {model: self._full_frame(model) for model in ("E2", "E4", "E5")}
        works: dict[str, Callable[[int], Any]] = {
            m: partial(lambda job, k: self.renderer.render(self._turned(job, k)), job) for m, job in jobs.items()
        }
        with tempfile.TemporaryDirectory() as folder:
            scene = self._stock(jobs["E2"], folder, max_depth=-1)
            works["path"] = lambda k: np.array(mi.render(scene, spp=16, seed=k))
            sensor = scene.sensors()[0]
            index = dr.arange(mi.UInt32, 640 * 480 * 16)
            pixel = index // 16
            place = mi.Point2f(mi.Float(pixel % 640) / 640, mi.Float(pixel // 640) / 480)
            ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
            dr.eval(ray)

            def embree(_: int) -> None:
                dr.eval(scene.ray_intersect_preliminary(ray, coherent=True).t)
                dr.sync_thread()

            works["embree"] = embree
            found = self._in_turns(works)
        cpu = {name: times[0] for name, times in found.items()}
        yield row("full-frame E2, 8 LEDs, 16 spp, a new pose per frame: CPU", cpu["E2"], "s")
        yield row("the same: wall", found["E2"][1], "s")
        yield row("the same / stock path at unlimited depth, CPU", cpu["E2"] / cpu["path"], "ratio")
        yield row("three coherent Embree rays a sample / our CPU", 3 * cpu["embree"] / cpu["E2"], "ratio")
        yield row("full-frame E4 / E2, CPU", cpu["E4"] / cpu["E2"], "ratio", 1.3)
        yield row("full-frame E5 / E2, CPU", cpu["E5"] / cpu["E2"], "ratio", 1.3)

    def cycles(self) -> Iterable[Row]:
        """CPU time and noise of Blender's Cycles and of this package on E2's meshes under one lamp, remote camera."""
        from eyerender.rendering.output.export import bake_meshes

        job, box = self._remote_eye()
        camera, samples = job.camera, 16 if self.small else 64
        view = {
            "position_mm": camera.nodal_point_mm.tolist(), "axis": camera.axis.tolist(), "focal_px": camera.K[0, 0],
            "resolution_px": list(camera.resolution_px), "iris_box": box,
            "lamps": [{"position_mm": lamp.position_mm.tolist(), "axis": lamp.axis.tolist(),
                       "radius_mm": float(lamp.radius_mm)} for lamp in job.lights],
        }  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            bake_meshes(job.eye, folder, rings=48, sectors=128)
            (Path(folder) / "view.json").write_text(json.dumps(view), encoding="utf-8")
            command = [self.cycles_python, str(ROOT / "scripts" / "_cycles.py"), folder, str(samples), "2"]
            done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": ""})
        if done.returncode:
            print("Cycles: bpy is not installed" if "bpy" in done.stderr else f"Cycles: {done.stderr[-300:]}")
            return
        found = json.loads(next(line for line in done.stdout.splitlines() if line.startswith('{"cpu_s"')))
        ours = self._in_turns({"ours": lambda k: self.renderer.render(self._turned(job, k), spp=1)})["ours"][0]
        x0, y0, x1, y1 = box
        part = self.renderer.radiance(job, spp=1)[y0:y1, x0:x1]
        noise = np.std(np.diff(part, axis=1)) / np.sqrt(2) / part.mean()
        yield row(f"Cycles, bare eye 640x480, {samples} spp: CPU", found["cpu_s"], "s")
        yield row("the same: noise of the iris", 100 * found["noise"], "%")
        yield row("this package, 1 spp: CPU", ours, "s")
        yield row("the same: noise of the iris", 100 * noise, "%")
        yield row("CPU of Cycles / ours", found["cpu_s"] / ours, "ratio")

    def _remote_eye(self) -> tuple[Any, list[int]]:
        """Job of a bare eye that fills a remote camera's picture, and the corners of a part that shows iris alone."""
        rigs = self.rigs
        camera = rigs.Camera(
            resolution_px=(640, 480), position_mm=(520.0, 0.0, -300.0), look_at_mm=(0.0, 0.0, 0.0),
            focal_length_px=9000.0,
        ).build()  # fmt: skip
        rig = rigs.LampRig(camera, (rigs.remote_rig().lights[0],))
        first_hit = rigs.PLAIN.model_copy(update={"limbus_width_mm": 0.0})
        job = rigs.job_of(rigs.eye_of("E2"), rig, (0, 0, 640, 480), look=first_hit, labels=False)
        return job, [365, 225, 390, 255]

    def surfaces_cost(self) -> Iterable[Row]:
        """Meshed corneas and blur by depth, against exact surfaces and no blur."""
        from eyerender.imaging.capture import render_job
        from eyerender.rig.imaging import Lens
        from eyerender.scene.shipped import load_scene

        rig = self.rigs.head_rig()
        for model in ("E2", "E5"):
            exact = self.rigs.job_of(self.rigs.eye_of(model), rig, (0, 0, 640, 480), (4.0, -3.0))
            mesh = replace(exact, mesh_edge_mm=0.1)
            costs = []
            for job in (exact, mesh):
                self.renderer.render(job, spp=4)
                costs.append(cpu_of(partial(self.renderer.render, job, spp=4), 3)[0])
            yield row(f"{model} head-mounted, surfaces: mesh / exact, CPU", costs[1] / costs[0], "ratio")
        sharp = render_job(load_scene("headset").frames(), 4)
        costs = []
        for job in (sharp, replace(sharp, lens=Lens(focus_mm=55.0))):
            self.renderer.render(job, spp=4)
            costs.append(cpu_of(partial(self.renderer.render, job, spp=4), 3)[0])
        yield row("headset, 4 spp, blurred by depth / sharp, CPU", costs[1] / costs[0], "ratio")

    def region_cost(self) -> Iterable[Row]:
        """CPU time of eyes in their lids with a new pose in each frame."""
        from eyerender.folders.imagefile import png_bytes

        headset = self._scene_job("headset", 4)
        desktop = self._scene_job("desktop_tracker", 0)
        bare = replace(headset, region=None)

        def whole(k: int) -> None:
            png_bytes(self.renderer.render(self._turned(headset, k), spp=4).dn.astype(np.uint8))

        found = self._in_turns(
            {
                "headset": whole,
                "the same pose": lambda _: self.renderer.render(headset, spp=4),
                "desktop": lambda k: self.renderer.render(self._turned(desktop, k), spp=4),
                "bare": lambda k: self.renderer.render(self._turned(bare, k), spp=4),
            }
        )
        yield row("headset 640x480, 8 LEDs, 4 spp, a new pose, labels, PNG: CPU", 1e3 * found["headset"][0], "ms")
        yield row("the same: wall", 1e3 * found["headset"][1], "ms")
        yield row("the same / one pose without PNG", found["headset"][0] / found["the same pose"][0], "ratio")
        yield row("the same / bare eye, a new pose each", found["headset"][0] / found["bare"][0], "ratio")
        yield row("desktop window 400x300, 2 LEDs, 4 spp, a new pose: CPU", 1e3 * found["desktop"][0], "ms")

    def host_time(self) -> Iterable[Row]:
        """Processor time of a frame outside Dr.Jit's kernels and outside tracing, and the clock without any kernel.

        Host time is the CPU time of a frame, with one thread, times the share of the clock in which no kernel runs.
        """
        import drjit as dr

        works = {
            "headset": (self._scene_job("headset", 4), 4),
            "desktop window": (self._scene_job("desktop_tracker", 0), 4),
            "full-frame bare E2": (self._full_frame("E2"), 16),
            "bare window 100x100": (self._small_window(), 16),
        }
        threads = dr.thread_count()
        if self.backend.name == "llvm":
            dr.set_thread_count(1)
        try:
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                for name, (job, spp) in works.items():
                    spent = []
                    for k in range(7 if self.small else 16):
                        dr.kernel_history_clear()
                        start = time.process_time(), time.perf_counter()
                        self.renderer.render(self._turned(job, k), spp=spp)
                        cpu, wall = time.process_time() - start[0], time.perf_counter() - start[1]
                        kernels, launched = _kernel_ms()
                        share = 1 - 1e-3 * kernels / wall
                        spent.append((1e3 * cpu * share, 100 * share, launched))
                    host, share, launched = np.median(spent[3:], axis=0)
                    yield row(f"{name}, a new pose: host time, one thread", host, "ms")
                    yield row("the same: share of the frame's time", share, "%")
                    yield row("the same: kernels launched", launched, "kernels")
            yield from self._outside_tracing()
        finally:
            if self.backend.name == "llvm":
                dr.set_thread_count(threads)
        yield from self._critical_path()

    def _outside_tracing(self) -> Iterable[Row]:
        """CPU time of what a headset frame needs beside its light and its samples."""
        import drjit as dr

        from eyerender.folders.imagefile import png_bytes
        from eyerender.rendering.glints.splatting import MirrorImages
        from eyerender.rendering.output.labels import part_labels
        from eyerender.rendering.scene.region import RegionScene

        job = self._scene_job("headset", 4)
        spent: dict[str, list[float]] = {}

        @contextmanager
        def timed(name: str) -> Iterator[None]:
            dr.sync_thread()
            start = time.process_time()
            yield
            dr.sync_thread()
            spent.setdefault(name, []).append(time.process_time() - start)

        for k in range(8 if self.small else 20):
            turned = self._turned(job, k)
            _, place = self.renderer.bind(self._turned(job, k - 1), lit=False)
            assert isinstance(place, RegionScene)
            with timed("mesh and tree of the pose"):
                place.show(turned.region, turned.globe)
            shown, place = self.renderer.bind(turned, lit=False)
            with timed("labels"):
                _ = part_labels(shown, turned.window)(), shown.host.lid_margins_px
            with timed("glints"):
                MirrorImages.of(turned, None).seen(place, shown.host.blur)
            traced = self.renderer._traced(turned, 4, (), None)
            with timed("lens and sensor"):
                done = traced.develop()
            assert done.labels is not None
            with timed("PNG of image and labels"):
                for picture in (done.dn.astype(np.uint8), done.labels.part):
                    png_bytes(picture)
        each = {name: 1e3 * np.array(times[3:]) for name, times in spent.items()}
        for name, times in each.items():
            yield row(f"headset, outside tracing: {name}, CPU", np.median(times), "ms")
        yield row("headset, all outside tracing, CPU", np.median(sum(each.values())), "ms")

    def _critical_path(self) -> Iterable[Row]:
        """Share of the clock in which no kernel runs while a run of headset frames is rendered and written."""
        import drjit as dr

        from eyerender.folders.imagefile import Writer
        from eyerender.imaging.capture import render_windows
        from eyerender.scene.shipped import load_scene

        scene = load_scene("headset").with_(spp=4)

        def run(folder: Path) -> float:
            start = time.perf_counter()
            with Writer() as writer:
                for image in render_windows(scene.frames(), renderer=self.renderer):
                    writer.put(folder / f"{image.name}.png", image.counts)
                    writer.put(folder / f"{image.name}.mask.png", image.parts)
            return time.perf_counter() - start

        with tempfile.TemporaryDirectory() as folder, dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            run(Path(folder))
            dr.kernel_history_clear()
            whole = run(Path(folder))
            idle = 1 - 1e-3 * _kernel_ms()[0] / whole
        yield row("headset frames in a run: clock in which no kernel runs", 100 * idle, "%")

    def region_noise(self) -> Iterable[Row]:
        """Relative noise of the light on iris, sclera and skin at 4 samples with 8 lamps, before the sensor's."""
        rigs = self.rigs
        rig = rigs.head_rig(count=8)
        job = rigs.job_of(rigs.eye_of("E2"), rig, rig.window(380, 200), look=rigs.PLAIN, region=_plain_region())
        few, many = (self.renderer.radiance(job, spp=spp) for spp in (4, 64 if self.small else 256))
        part = self.renderer.labels(job).part
        for name, which in (("skin", 0), ("sclera", 1), ("iris", 2)):
            inside = part == which
            for axis in (0, 1):
                for shift in (1, -1, 2, -2):
                    inside &= np.roll(part, shift, axis) == which
            rest = (few / np.maximum(many, 1e-12))[inside]
            yield row(
                f"noise of the {name} in a region, 8 LEDs, 4 spp (median of |d| x 1.48)",
                148 * np.median(np.abs(rest - np.median(rest))),
                "%",
            )

    def subjects(self) -> Iterable[Row]:
        """What a subject never seen adds to its first frame, without and with its maps on disk."""
        from eyerender.region.mapcache import without_cache

        headset = replace(self._scene_job("headset", 4), labels=False)

        def subject(seed: int) -> Any:
            first_hit = headset.look.model_copy(update={"iris_seed": seed})
            return replace(headset, region=headset.region.model_copy(update={"seed": seed}), look=first_hit)

        def both(seed: int) -> list[float]:
            return [1e3 * cpu_of(lambda: self.renderer.render(subject(seed), spp=4), 1)[0] for _ in range(2)]

        count = 2 if self.small else 6
        self.renderer.render(headset, spp=4)
        with without_cache():
            made = np.array([both(9000 + k) for k in range(count)])
        for seed in range(8000, 8000 + count + 4):  # onto the disk, and out of memory again
            self.renderer.render(subject(seed), spp=4)
        read = np.array([both(8000 + k) for k in range(count)])
        yield row("headset, a subject never seen in each frame, empty map cache: CPU", np.median(made[:, 0]), "ms")
        yield row("more than a known subject", np.median(made[:, 0] - made[:, 1]), "ms")
        yield row("more than a known subject, with maps on disk", np.median(read[:, 0] - read[:, 1]), "ms")

    def first_frames(self) -> Iterable[Row]:
        """First frame of a fresh process from "renderer ready", kernels and maps on disk; kernels it compiles."""
        for name in ("bare", "headset"):
            code = (
                f"import sys; sys.path[:0] = [{str(ROOT / 'scripts')!r}]; import bench_render as b\n"
                f"import time; bench = b.Bench(b.choose_backend({self.backend.name!r}, 2), True)\n"
                f"import drjit as dr; dr.set_flag(dr.JitFlag.KernelHistory, True); job = bench.first_job({name!r})\n"
                "start = time.process_time(), time.perf_counter(); bench.renderer.render(job, spp=4)\n"
                "spent = time.process_time() - start[0], time.perf_counter() - start[1]\n"
                "kernels = dr.kernel_history([dr.KernelType.JIT])\n"
                "print(1e3 * spent[0], 1e3 * spent[1])\n"
                "print(len({k['hash'] for k in kernels if not (k['cache_disk'] or k['cache_hit'])}))"
            )
            for _ in range(2):
                done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
            cpu, wall, compiled = (float(x) for x in done.stdout.split()[-3:])
            yield row(f"first frame of a fresh process, {name}: CPU", cpu, "ms")
            yield row(f"first frame of a fresh process, {name}: latency", wall, "ms")
            yield row(f"kernels that it compiles, {name}", compiled, "kernels", 0)

    def first_job(self, name: str) -> Any:
        """Job of a first frame."""
        return self._full_frame("E2") if name == "bare" else self._scene_job("headset", 0)

    def _varied(self, count: int, seed: int = 0) -> Iterable[Any]:
        """Jobs of one structure whose every number varies."""
        rigs = self.rigs
        rng = np.random.default_rng(seed)
        head = rigs.head_rig()
        for _ in range(count):
            eye = rigs.eye_of(str(rng.choice(["E1", "E2"])), "right", float(rng.uniform(2.5, 6.0)))
            shift = rng.uniform(-2, 2, 3)
            camera = rigs.Camera(
                resolution_px=(640, 480),
                position_mm=tuple(float(x) for x in 35 * np.array([0.87, -0.2, -0.4]) + shift),
                look_at_mm=(0.0, 0.0, 0.0), focal_length_px=float(rng.uniform(500, 700)),
            ).build()  # fmt: skip
            lights = tuple(
                replace(lamp, position_mm=lamp.position_mm + shift, intensity_mw_sr=float(rng.uniform(0.1, 0.5)))
                for lamp in head.lights[: int(rng.integers(1, 6))]
            )
            first_hit = rigs.PLAIN.model_copy(update={"iris_albedo": float(rng.uniform(0.1, 0.5))})
            pose = (float(rng.uniform(-20, 20)), float(rng.uniform(-20, 20)))
            rig = rigs.LampRig(camera, lights)
            yield rigs.job_of(eye, rig, (304, 224, 32, 32), pose, look=first_hit, seed=int(rng.integers(1 << 40)))

    def recompiles(self) -> Iterable[Row]:
        """Kernels that later frames launch and the first did not (by hash: a cache on disk hides nothing)."""
        import drjit as dr

        def kernels(jobs: Iterable[Any]) -> set[Any]:
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                for job in jobs:
                    self.renderer.render(job)
                return {k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])}

        first, *later = self._varied(30)
        known = kernels([first])
        yield row("new kernels after the first frame, 29 varied frames", len(kernels(later) - known), "kernels", 0)

    def fixed_cost(self) -> Iterable[Row]:
        """Time of a frame of 32 x 32 pixels at 1 spp with two lamps: packing, tracing, launching, glints."""
        rigs = self.rigs
        rig = rigs.remote_rig()
        lamps = (rig.lights[0], replace(rig.lights[0], position_mm=rig.lights[0].position_mm + np.array([0, 80.0, 0])))
        eye = rigs.eye_of("E2")
        jobs = [
            rigs.job_of(eye, rig, rig.window(32, 32), (float(k % 20), 0.1 * k), lights=lamps, labels=False)
            for k in range(60)
        ]
        times = []
        for job in jobs:
            start = time.perf_counter(), time.process_time()
            self.renderer.render(job, spp=1)
            times.append((time.perf_counter() - start[0], time.process_time() - start[1]))
        wall, cpu = 1e3 * np.median(times, axis=0)
        yield row("fixed cost of a frame, CPU (median of 60)", cpu, "ms", 15)
        yield row("fixed cost of a frame, wall (median of 60)", wall, "ms")

    def _small_window(self) -> Any:
        """Job of a bare eye in a window of 100 x 100 px of a remote camera."""
        rig = self.rigs.remote_rig()
        return self.rigs.job_of(self.rigs.eye_of("E2"), rig, rig.window(100, 100))

    def memory(self) -> Iterable[Row]:
        """Growth of the resident memory between two frames, everything varied."""
        first, last = (20, 120) if self.small else (100, 1100)
        at = 0.0
        for k, job in enumerate(self._varied(last + 1, seed=1)):
            self.renderer.render(job, spp=4)
            if k == first:
                at = resident_mib()
        yield row(f"resident memory, frame {last} - frame {first}", resident_mib() - at, "MB", 30)
        yield row("peak memory of all of this", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "MiB")

    def determinism(self) -> Iterable[Row]:
        """Differing digests of one job: here, with other threads, and in a fresh process with two threads."""
        import drjit as dr

        job = next(iter(self._varied(1, seed=9)))
        job = replace(job, window=(200, 150, 160, 120))
        digests = [_digest(self.renderer.render(job, spp=16))]
        if self.backend.name == "llvm":
            before = dr.thread_count()
            dr.set_thread_count(1)
            digests.append(_digest(self.renderer.render(job, spp=16)))
            dr.set_thread_count(before)
        code = (
            f"import sys; sys.path[:0] = [{str(ROOT / 'scripts')!r}]; import bench_render as b\n"
            "from dataclasses import replace\n"
            f"bench = b.Bench(b.choose_backend({self.backend.name!r}, 2), True)\n"
            "job = replace(next(iter(bench._varied(1, seed=9))), window=(200, 150, 160, 120))\n"
            "print(b._digest(bench.renderer.render(job, spp=16)))"
        )
        fresh = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        digests.append(fresh.stdout.strip())
        yield row("one seed, 1 or 2 threads, fresh process: digests beyond one", len(set(digests)) - 1, "digests", 0)


def _kernel_ms() -> tuple[float, int]:
    """Execution time (ms) of the kernels since the history was cleared, and their number."""
    import drjit as dr

    dr.sync_thread()
    history = dr.kernel_history()
    return sum(k.get("execution_time", 0.0) for k in history), len(history)


def _plain_region() -> Any:
    """Region of even skin, without hairs."""
    from eyerender.region.anatomy import Region

    hairless = {"upper_count": 0, "lower_count": 0}
    even = {"relief_mm": 0.0, "wrinkles": 0.0, "pores": 0.0, "mottling": 0.0, "veins": 0.0, "sheen": 0.0}
    return Region.from_mapping({"skin": even, "lashes": hairless, "brow": {"count": 0}})


def _digest(done: Any) -> str:
    return hashlib.sha256(done.irradiance.tobytes() + done.dn.tobytes()).hexdigest()


def main() -> int:
    """Measure, print, write."""
    parser = options_of(__doc__, "fewer samples and poses")
    parser.add_argument("--backend", choices=["auto", "llvm", "cuda"], default="llvm")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--cycles", metavar="PYTHON", default=sys.executable, help="a Python that has bpy")
    options = parser.parse_args()
    backend = choose_backend(options.backend, options.threads)
    report = Report()
    report.extend(Bench(backend, options.quick, options.cycles).rows())
    if backend.name != "cuda":
        print("physics on a GPU: not measured, no GPU here")
    machine = {"device": backend.device, "threads": backend.threads}
    return report.finish(options.json, ("eyerender", "numpy"), machine=machine, versions=backend.versions)


if __name__ == "__main__":
    sys.exit(main())
