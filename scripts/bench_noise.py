#!/usr/bin/env python3
"""Noise of features as `eyerender rig` states it, against the scatter of `extract` on rendered frames.

    bench_noise.py [--quick] [--json F]

Frames are rendered with blur discs of 0, 1 and 3 px at the pupil, and with an eye at rest and one that turns by 100
deg/s. Each is exposed 100 times with other noise, and extracted. The scatter is the standard deviation of the pupil's
centre and of each glint, per axis, where they are found within ten median distances of their median. It is compared
with `extracted_noise`, propagated to the centre of an ellipse by the exact outline. The constants of `extracted_noise`
were fitted on the frames of the set `fitted`; the bars are those of the set `checked`, which has other scenes, irises
and directions. The sampling error of a standard deviation is 5 %.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from _bench import Report, options_of, row, single_threaded

single_threaded()

import eyerender as er
from eyerender.base.arrays import Floats
from eyerender.design.information import outline_normals
from eyerender.design.noise import PUPIL_DEPTH_MM, extracted_noise, sensor_noise
from eyerender.imaging.capture import render_windows
from eyerender.rig.exposure import recorded

DRAWS, FEW = 100, 12
BAR = 0.15
DISCS_PX, SPEEDS_DEG_S = (0.0, 1.0, 3.0), (0.0, 100.0)
FRAMES = {
    "fitted": (("head_mounted", 4, 1), ("head_mounted", 1, 1), ("eyelink_desktop", 4, 1), ("desktop_tracker", 4, 1)),
    "checked": (("head_mounted", 7, 2), ("head_mounted", 3, 3), ("eyelink_desktop", 2, 2), ("desktop_tracker", 6, 2)),
    "glints on the outline": (("headset", 0, 1),),
}
"""Sets of (scene, number of its frame, seed of the iris)."""


@dataclass(frozen=True)
class Measured:
    """Scatter per axis, stated noise and noise of the sensor alone (px) of the pupil's centre and of the glints."""

    centre: tuple[float, float, float]
    glints: list[tuple[float, float, float]]
    found: float


def scene_of(name: str, seed: int, disc_px: float, speed_deg_s: float) -> er.Scene:
    """A shipped scene whose camera has a blur disc at the pupil, before an eye that turns."""
    scene = er.load_scene(name)
    camera, sensor = scene.rig.cameras[0], scene.spec.sensor
    eye = scene.eye_position_mm(scene.spec.subject.eyes[0]) + np.array(scene.spec.subject.head_positions_mm[0])
    depth = float(camera.depth(eye - [PUPIL_DEPTH_MM, 0.0, 0.0]))
    strength = float(camera.K[0, 0]) ** 2 * sensor.pixel_pitch_um * 1e-3 / sensor.f_number
    changes: dict[str, Any] = {"look.iris_seed": seed, "lens.focus_mm": 1.0 / (1.0 / depth - disc_px / strength)}
    if speed_deg_s:
        changes["motion"] = {"eye_deg_s": [speed_deg_s, 0.0]}
    return scene.with_(changes)


def scatter(points: Floats) -> float:
    """Standard deviation per axis of points (n, 2), without those far from the others."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    kept = points[distance <= 10.0 * np.median(distance)]
    return float(np.sqrt(np.trace(np.cov(kept.T)) / 2.0)) if len(kept) > 2 else np.nan


def centre_bound(points: Floats, edge_px: float) -> float:
    """Standard deviation per axis of the centre of an ellipse through an outline (k, 2) with a noise per px of it."""
    normal, length = (part[0] for part in outline_normals(points[None], np.ones((1, len(points)), dtype=bool)))
    about = points - points.mean(axis=0)
    moves = np.stack([np.eye(2)[0] + 0 * about, np.eye(2)[1] + 0 * about, about, about * [1, -1], about[:, ::-1]])
    by = np.einsum("fkx,kx->kf", moves, normal)
    return float(edge_px * np.sqrt(np.trace(np.linalg.inv((by * length[:, None]).T @ by)[:2, :2]) / 2.0))


def measured(scene: er.Scene, frame: int, draws: int) -> Measured:
    """Expose and extract one frame many times."""
    frames = scene.frames().take([frame])
    (image,) = render_windows(frames, backend="llvm")
    sensor, camera, nm = scene.spec.sensor, scene.rig.cameras[0], scene.spec.wavelength_nm
    exposed = [
        replace(image, counts=recorded(sensor, camera, image.window, image.irradiance, nm, k)) for k in range(draws)
    ]
    seen, exact, alone = er.ImageObserver(backend="llvm").observe_images(exposed), er.trace(frames), sensor_noise(scene)
    stated, points = extracted_noise(alone), exact.pupil.points_px[0]
    centre, plain = (centre_bound(points, float(noise.outline_px[0])) for noise in (stated, alone))
    glints = []
    for k in range(len(scene.rig.lights)):
        there = seen.glints.ok & (seen.glints.light == k)
        if there.any(axis=1).mean() > 0.9:
            found = scatter(seen.glints.xy_px[there])
            glints.append((found, float(stated.glint_px[0, k]), float(alone.glint_px[0, k])))
    return Measured((scatter(seen.pupil.centre_px[seen.pupil.ok]), centre, plain), glints, float(seen.pupil.ok.mean()))


def main() -> int:
    """Measure all frames and print the rows."""
    options = options_of(__doc__, f"{FEW} exposures of the first frame of each set, without bars").parse_args()
    report, draws = Report(), FEW if options.quick else DRAWS
    for kind, frames in FRAMES.items():
        off: list[float] = []
        ratios: list[float] = []
        for name, frame, seed in frames[: 1 if options.quick else None]:
            for disc in DISCS_PX:
                for speed in SPEEDS_DEG_S:
                    found = measured(scene_of(name, seed, disc, speed), frame, draws)
                    what = f"{kind}, {name} {frame}, iris {seed}, {disc:g} px, {speed:g} deg/s"
                    actual, stated, alone = found.centre
                    report.add(row(f"{what}: found", found.found, "share"))
                    report.add(row(f"{what}: bound of the centre", alone, "px"))
                    report.add(row(f"{what}: centre, stated over scatter", stated / actual, "ratio"))
                    off.append(abs(stated / actual - 1.0))
                    if found.glints:
                        one = [s / a for a, s, _ in found.glints]
                        report.add(row(f"{what}: glints, stated over scatter, median", float(np.median(one)), "ratio"))
                        ratios += one
        must = BAR if kind == "checked" and not options.quick else None
        report.add(row(f"{kind}: centre, stated off scatter, median", float(np.median(off)), "share", must))
        report.add(row(f"{kind}: centre, stated off scatter, largest", max(off), "share"))
        within = float(np.mean(np.array(off) <= BAR))
        report.add(row(f"{kind}: centre, frames within {100 * BAR:.0f} %", within, "share"))
        if ratios:
            gap = abs(float(np.median(ratios)) - 1.0)
            report.add(row(f"{kind}: glints, median of stated over scatter off 1", gap, "share", must))
    return report.finish(options.json, ("numpy", "mitsuba"))


if __name__ == "__main__":
    sys.exit(main())
