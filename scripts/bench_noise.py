#!/usr/bin/env python3
"""Noise of features as `eyerender rig` states it, against the scatter of `extract` on rendered frames.

    bench_noise.py [--quick] [--json F] [--only fitted|checked]

Drawn adults with bare eyes are rendered with blur discs of 0, 1 and 3 px at the pupil, with an eye at rest and one that
turns by 100 deg/s, in a frame whose glints are at least 5 px from the outline of the pupil. Each frame is exposed 100
times with other noise, and extracted. The scatter is the standard deviation of the pupil's centre and of each glint,
per axis, where they are found within ten median distances of their median. It is compared with `extracted_noise`,
propagated to the centre of an ellipse by the exact outline. The scatter of the extractor's edge points along the
outline's normals is compared too: it leaves out what the choice of points and the fit of an ellipse add. The factor of
the glints was fitted on the people and rigs `fitted`; the bars are those of other people and rigs, `checked`. The
sampling error of a scatter is 5 %.
"""

from __future__ import annotations

import itertools
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
from eyerender.extraction.preprocessing import prepare
from eyerender.extraction.pupil.search import find_pupil
from eyerender.extraction.result import PupilResult
from eyerender.extraction.settings import ExtractionSettings, Shape
from eyerender.imaging.capture import EyeImage, render_windows
from eyerender.rig.exposure import recorded
from eyerender.scene.spec import SceneSpec

DRAWS, FEW = 100, 12
BAR = 0.15
DISCS_PX, SPEEDS_DEG_S = (0.0, 1.0, 3.0), (0.0, 100.0)
FRAMES = {
    "fitted": (("head_mounted", 0, 1000), ("eyelink_desktop", 1, 1000), ("desktop_tracker", 2, 1000),
               ("head_mounted", 3, 1000)),
    "checked": (("headset", 0, 2000), ("guestrin2006", 1, 2000), ("headset", 2, 2000), ("eyelink_desktop", 3, 2000)),
}  # fmt: skip
"""Sets of (scene, number of the adult, seed of the population)."""
CLEAR_PX, NEAR_PX = 5.0, 2.0


@dataclass(frozen=True)
class Measured:
    """Scatter per axis, stated noise and bound (px) of the pupil's centre, and stated noise over scatter of others."""

    scatter: float
    stated: float
    bound: float
    edges: float
    glints: list[float]
    found: float


def scene_of(name: str, subject: int, seed: int, disc_px: float, speed_deg_s: float) -> er.Scene:
    """The right eye of an adult in a shipped scene, without lids, whose camera has a blur disc at the pupil."""
    data = er.load_scene(name).spec.to_mapping()
    data = {key: value for key, value in data.items() if key not in ("eye", "region")}
    data |= {
        "population": {"preset": "adults", "seed": seed, "subject": subject},
        "subject": {**data["subject"], "eyes": ["right"]},
    }
    scene = er.Scene.of(SceneSpec.from_mapping(data))
    camera, sensor = scene.rig.cameras[0], scene.spec.sensor
    eye = scene.eye_position_mm("right") + np.array(scene.spec.subject.head_positions_mm[0])
    depth = float(camera.depth(eye - [PUPIL_DEPTH_MM, 0.0, 0.0]))
    strength = float(camera.K[0, 0]) ** 2 * sensor.pixel_pitch_um * 1e-3 / sensor.f_number
    changes: dict[str, Any] = {"region": None, "lens.focus_mm": 1.0 / (1.0 / depth - disc_px / strength)}
    if speed_deg_s:
        changes["motion"] = {"eye_deg_s": [speed_deg_s, 0.0]}
    return scene.with_(changes)


def clear_frame(scene: er.Scene, number: int) -> int:
    """The frame of a person whose glints are all off the outline of the pupil."""
    seen = er.trace(scene.frames())
    gap = np.linalg.norm(seen.glints.xy_px[:, :, None] - seen.pupil.points_px[:, None], axis=3)
    clear = np.flatnonzero(np.nanmin(gap, axis=(1, 2)) > CLEAR_PX)
    return int(clear[number % len(clear)])


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


def edge_scatter(scene: er.Scene, exposed: list[EyeImage], outline: Floats) -> float:
    """Standard deviation of one px of an outline (k, 2), from that of the edge point nearest to each of its points.

    Points within 2 sqrt(pi) f share their error, with the width f of the extractor's filter.
    """
    normal, off = outline_normals(outline[None], np.ones((1, len(outline)), dtype=bool))[0][0], []
    widths, settings = [], ExtractionSettings()
    for one in exposed:
        image = prepare(np.asarray(one.counts), scene.spec.sensor.bit_depth, 1.0)
        if isinstance(image, str):
            continue
        pupil = find_pupil(image, Shape.of(settings, (one.window[3], one.window[2])), "dark", None)
        if isinstance(pupil, PupilResult):
            continue
        edges = pupil.candidate.edges
        points = edges.points_px + np.array(one.window[:2])
        gap = np.linalg.norm(outline[:, None] - points, axis=2)
        away = np.einsum("ni,ni->n", points[gap.argmin(axis=1)] - outline, normal)
        off.append(np.where(gap.min(axis=1) < NEAR_PX, away, np.nan))
        widths.append(edges.filter_px)
    all_off = np.array(off)
    some = all_off[:, np.isfinite(all_off).mean(axis=0) > 0.9]
    middle = np.nanmedian(some, axis=0)
    deviation = 1.4826 * np.nanmedian(np.abs(some - middle), axis=0)
    return float(np.median(deviation) * np.sqrt(2.0 * np.sqrt(np.pi) * np.mean(widths)))


def measured(scene: er.Scene, frame: int, draws: int) -> Measured:
    """Expose and extract one frame many times."""
    frames = scene.frames().take([frame])
    (image,) = render_windows(frames, backend="llvm")
    sensor, camera, nm = scene.spec.sensor, scene.rig.cameras[0], scene.spec.wavelength_nm
    exposed = [
        replace(image, counts=recorded(sensor, camera, image.window, image.irradiance, nm, k)) for k in range(draws)
    ]
    seen, exact, alone = er.ImageObserver(backend="llvm").observe_images(exposed), er.trace(frames), sensor_noise(scene)
    stated, points = extracted_noise(scene), exact.pupil.points_px[0]
    centre, least = (centre_bound(points, float(noise.outline_px[0])) for noise in (stated, alone))
    glints = []
    for k in range(len(scene.rig.lights)):
        there = seen.glints.ok & (seen.glints.light == k)
        if there.any(axis=1).mean() > 0.9:
            glints.append(float(stated.glint_px[0, k]) / scatter(seen.glints.xy_px[there]))
    found = seen.pupil.ok
    edges = float(stated.outline_px[0]) / edge_scatter(scene, exposed, points)
    return Measured(scatter(seen.pupil.centre_px[found]), centre, least, edges, glints, float(found.mean()))


def main() -> int:
    """Measure all frames and print the rows."""
    parser = options_of(__doc__, f"{FEW} exposures of the first person of each set, without bars")
    parser.add_argument("--only", choices=tuple(FRAMES), help="one of the two sets")
    options = parser.parse_args()
    report, draws = Report(), FEW if options.quick else DRAWS
    for kind in FRAMES if options.only is None else [options.only]:
        centres: list[float] = []
        edges: list[float] = []
        glints: list[float] = []
        for name, subject, seed in FRAMES[kind][: 1 if options.quick else None]:
            for disc, speed in itertools.product(DISCS_PX, SPEEDS_DEG_S):
                scene = scene_of(name, subject, seed, disc, speed)
                found = measured(scene, clear_frame(scene, subject), draws)
                what = f"{kind}, {name} {subject}, {disc:g} px, {speed:g} deg/s"
                report.add(row(f"{what}: found", found.found, "share"))
                report.add(row(f"{what}: scatter of the centre", found.scatter, "px"))
                report.add(row(f"{what}: bound of the centre", found.bound, "px"))
                centres.append(found.stated / found.scatter)
                report.add(row(f"{what}: centre, stated over scatter", centres[-1], "ratio"))
                edges.append(found.edges)
                report.add(row(f"{what}: edge points, stated over scatter", edges[-1], "ratio"))
                if found.glints:
                    glints.append(float(np.median(found.glints)))
                    report.add(row(f"{what}: glints, stated over scatter, median", glints[-1], "ratio"))
        must = BAR if kind == "checked" and not options.quick else None
        for what, ratios in (
            ("centre", np.array(centres)), ("edge points", np.array(edges)), ("glints", np.array(glints))
        ):  # fmt: skip
            off = np.abs(ratios - 1.0)
            report.add(row(f"{kind}: {what}, stated over scatter, median frame", float(np.median(ratios)), "ratio"))
            report.add(row(f"{kind}: {what}, stated off scatter, median frame", float(np.median(off)), "share", must))
            report.add(row(f"{kind}: {what}, stated off scatter, largest", float(off.max()), "share"))
            within = float(np.mean(off <= BAR))
            report.add(row(f"{kind}: {what}, frames within {100 * BAR:.0f} %", within, "share"))
    return report.finish(options.json, ("numpy", "mitsuba"))


if __name__ == "__main__":
    sys.exit(main())
