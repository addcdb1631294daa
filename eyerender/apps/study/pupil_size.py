"""Pupil size: how its measured size depends on gaze, and the gaze error that a change of the pupil causes.

(a) A person looks at points up to 30 deg away, and the pupil stays as it is; s(g) is the measured size at gaze g. The
error within the person is s(g) / s(0) - 1, after a correction that a user can apply:

    cosine    divides the root of the area by sqrt(cos t), t between the lines from the eye to camera and target
              (Hayes and Petrov 2016, Behav. Res. Methods 48, 510-527, who divide the area by cos t)
    table     divides by the mean of s(g) / s(0) over other people, those of the other half

(b) A regression of directions is calibrated at one luminance and tested at others, where its error changes by d. With
the stop's centre fixed, d is due to the corneal optics of a wider stop; the rest is due to the shift of the centre. The
mean of d over the targets is a shift of gaze, which Drewes et al. (2014) measured. What differs between the targets is
the part that depends on direction, of which Hooge et al. (2021) ask whether the cornea explains it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import binary_fill_holes, label
from scipy.stats import linregress
from scipy.stats import t as student

from ...analytic.observer import trace
from ...base.arrays import Floats
from ...eye.batch import stack_stops, take_stops
from ...eye.entrance import entrance_pupil, entrance_pupil_mm
from ...eye.model import EyeModel
from ...gaze.budget import error_vectors_deg
from ...gaze.directions import DirectionRegression
from ...imaging.capture import EyeImage
from ...scene import Scene, load_scene
from ...scene.observation import EYES, Observations
from ...scene.spec import SceneSpec
from .observing import Observing, extracted
from .over_people import OtherEyes, interval, line_of, resampled, summary
from .results import Finding, ModelResults
from .study import Study, StudyJob, changed, name_of, of_person

KEY = ("own", "analytic")
ECCENTRICITIES_DEG, TURNS = (10.0, 20.0, 30.0), 8
STOPS_MM, TABLE_MM = (3.0, 4.0, 6.0), 4.0
LUMINANCES, CALIBRATED = (0.3, 1.0, 10.0, 100.0, 1000.0), 10.0
CAMERAS: Mapping[str, tuple[str, float, float]] = {
    "remote, below": ("eyelink_desktop", 0.0, -250.0),
    "remote, above": ("eyelink_desktop", 0.0, 250.0),
    "headset, below": ("head_mounted", 8.2, -14.8),
    "headset, temporal": ("head_mounted", 17.0, 0.0),
}
"""Place of the camera -> scene of the rig, and mm by which it lies temporal (headsets) and above the eye."""
PICTURED = ("remote, below", "headset, below")
CAUSES, BARE = ("whole", "optics", "shift"), "without refraction"
DREWES_DEG, LEAK = 2.6, 1.3


def camera_scene(camera: str, person: Mapping[str, Any]) -> Scene:
    """Build the scene of a person with both eyes, a camera of each in headsets, and a point ahead of the right eye."""
    name, aside, up = CAMERAS[camera]
    data = load_scene(name).spec.to_mapping()
    data["subject"]["eyes"] = list(EYES)
    data["targets"] = {"world_mm": [[1000.0, -31.5, 0.0]]}
    rig = data["rig"]
    if name == "eyelink_desktop":
        for one in (*rig["cameras"], *rig["lights"]):
            one["position_mm"][2] = up
    else:
        lens, ring = rig["cameras"][0], rig["lights"][0]
        rig["cameras"], rig["lights"] = [], []
        for k, (side, sign) in enumerate(zip(EYES, (-1.0, 1.0), strict=True)):
            at = {"eyes": [side], "look_at_mm": [0.0, sign * 31.5, 0.0], "name": side}
            rig["cameras"].append({**lens, **at, "position_mm": [30.6, sign * (31.5 + aside), up]})
            aim = {"eyes": [side], "aim_mm": at["look_at_mm"], "ring": {**ring["ring"], "camera": k}}
            rig["lights"].append({**ring, **aim})
    return of_person(Scene.of(SceneSpec.from_mapping(data)), person)


def gazes_deg() -> Floats:
    """Return eccentricity and direction (25, 2) deg of the gazes, straight ahead first."""
    around = np.arange(TURNS) * 360.0 / TURNS
    return np.array([(0.0, 0.0), *((e, d) for e in ECCENTRICITIES_DEG for d in around)])


def ringed(scene: Scene, stop_mm: float) -> Scene:
    """Let the right eye look at the points of the gazes, one metre away, with a stop of one size."""
    e, d = np.radians(gazes_deg()).T
    ways = np.stack([np.cos(e), np.sin(e) * np.cos(d), np.sin(e) * np.sin(d)], axis=1)
    points = scene.eye_position_mm("right") + 1000.0 * ways
    return changed(scene, {"targets": {"world_mm": points.tolist()}, "subject": {"eyes": ["right"]},
                           "eye": {"pupil_diameter_mm": stop_mm}})  # fmt: skip


def sizes_of(seen: Observations) -> dict[str, Floats]:
    """Return the sizes (n,) px of pupils: semi-axis, and root of the area over pi."""
    axes = seen.pupil.semi_axes_px
    return {"major axis": axes[:, 0], "root of area": np.sqrt(axes.prod(axis=1))}


def cosines(seen: Observations, scene: Scene) -> Floats:
    """Return the cosine (n,) of the angle between the lines from the eye to its camera and to its target."""
    place = seen.index.eye_position_mm + seen.index.head_mm
    cameras = np.array([scene.rig.cameras[c].nodal_point_mm for c in seen.index.camera])
    ways = (seen.index.target_mm - place, cameras - place)
    a, b = (way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways)
    return np.asarray(np.sum(a * b, axis=1))


def thresholded(image: EyeImage, level: float, centre_px: Floats) -> float:
    """Compute the root of the area over pi (px) of the dark patch around a point, its glints filled."""
    dark, _ = label(image.counts < level)
    x, y = np.clip(np.rint(centre_px - image.window[:2]).astype(int), 0, np.array(dark.shape)[::-1] - 1)
    found = np.bincount(dark[max(y - 5, 0) : y + 6, max(x - 5, 0) : x + 6].ravel(), minlength=2)
    if not found[1:].any():
        return np.nan
    return float(np.sqrt(binary_fill_holes(dark == 1 + np.argmax(found[1:])).sum() / np.pi))


def half_level(image: EyeImage, seen: Observations) -> float:
    """Return the level midway between pupil and iris, which a user sets once while the eye looks straight ahead."""
    y, x = np.indices(image.counts.shape)
    away = np.hypot(*(np.stack([x, y]) - (seen.pupil.centre_px[0] - image.window[:2])[:, None, None]))
    r = float(seen.pupil.semi_axes_px[0, 1])
    inside, around = (image.counts[(away > a * r) & (away < b * r)] for a, b in ((0.0, 0.8), (1.3, 1.6)))
    return float(np.median(inside) + np.median(around)) / 2.0


def pictured(scene: Scene, observing: Observing) -> dict[str, Floats]:
    """Measure the pupils of rendered images of the bare eye: the extractor's ellipse, and the thresholded area."""
    images = list(observing.images_of(changed(scene, {"region": None, "sensor": {"noise": observing.kind == "image"}})))
    seen = extracted(images)
    level = half_level(images[0], seen)
    areas = np.array([thresholded(i, level, at) for i, at in zip(images, seen.pupil.centre_px, strict=True)])
    found = sizes_of(seen)
    # A patch that leaks out of the pupil is no pupil.
    return {**found, "thresholded area": np.where(areas < LEAK * found["root of area"], areas, np.nan)}


def straight_ahead(scene: Scene, seen: Observations) -> dict[str, float]:
    """Compare the major axis at the straight gaze with the stop, and with the entrance pupil seen from far away."""
    eye = scene.eye("right")
    place = scene.eye_position_mm("right") + entrance_pupil(eye)[0]
    measured = 2.0 * seen.pupil.semi_axes_px[0, 0] / scene.rig.cameras[int(seen.index.camera[0])].scale_at(place)
    return {"stop": measured / scene.pupil_diameter_mm, "entrance pupil": measured / entrance_pupil_mm(eye)}


def artefacts(scene: Scene) -> dict[str, Floats]:
    """Compute the changes d (luminances, eyes, targets, 2) deg of the gaze error, to the right and up, by cause."""
    points = [[1000.0, y, z] for z in (130.0, 0.0, -130.0) for y in (220.0, 110.0, 0.0, -110.0, -220.0)]
    scene = changed(scene, {"targets": {"world_mm": points}, "eye": {"pupil_diameter_mm": None}})
    lit = {one: changed(scene, {"subject": {"luminance_cd_m2": one}}) for one in LUMINANCES}
    frames = lit[CALIBRATED].frames()
    seen = trace(frames)
    fitted = DirectionRegression("R3").fit(seen, scene.rig)
    wanted = frames.index.target_mm - frames.index.eye_position_mm
    own = [lit[CALIBRATED].eye(side).stop for side in EYES]
    found: dict[str, list[Floats]] = {"whole": [], "optics": []}
    for one in lit.values():
        fixed = [replace(one.eye(side).stop, centre_mm=stop.centre_mm) for side, stop in zip(EYES, own, strict=True)]
        stops = take_stops(stack_stops(fixed), frames.index.eye)
        for cause, some in (("whole", one.frames()), ("optics", OtherEyes.frames(frames, lambda eye: eye, stops))):
            vectors = error_vectors_deg(fitted.predict_rays(trace(some), scene.rig).direction, wanted)
            found[cause].append(np.stack([vectors[frames.index.eye == eye] for eye in (0, 1)]))
    start = LUMINANCES.index(CALIBRATED)
    out = {cause: np.stack(some) - some[start] for cause, some in found.items()}
    return {**out, "shift": out["whole"] - out["optics"]}


class PupilSizeStudy(Study):
    """The pupil's measured size over gaze, and gaze over the pupil's size."""

    title = "Pupil size"
    about = (
        "The size of a pupil that a camera measures depends on gaze, and the gaze that a tracker reports depends on "
        "that size. Drawn people look at 25 points up to 30 deg away with a pupil of constant size, and at 15 "
        "points while the luminance changes the pupil.",
        "Corrections are tested on people kept apart: the table of each half of the people comes from the other half.",
    )
    eyes = ()
    people = 48

    def part(self, job: StudyJob) -> ModelResults:
        """Measure one person: sizes over gaze and artefacts by ray optics, or sizes in images."""
        person = job.person or {}
        out = ModelResults(eye_model=name_of(person), person=person)
        sizes = out.more["sizes"] = {}
        exact = job.observing.kind == "analytic"
        for camera in CAMERAS if exact else PICTURED:
            scene = camera_scene(camera, person)
            for mm in STOPS_MM if exact else (TABLE_MM,):
                own = ringed(scene, mm)
                seen = trace(own)
                found = sizes_of(seen) if exact else pictured(own, job.observing)
                sizes[job.observing.kind, camera, mm] = {**found, "cosine": cosines(seen, own)}
                if not exact:
                    continue
                out.more.setdefault("straight", {})[camera, mm] = straight_ahead(own, seen)
                if mm == TABLE_MM:
                    bare = OtherEyes.frames(own.frames(), _without_refraction)
                    sizes[BARE, camera, mm] = {**sizes_of(trace(bare)), "cosine": cosines(seen, own)}
            if exact:
                out.more.setdefault("artefacts", {})[camera] = artefacts(scene)
                out.more["refraction_d"] = (
                    own.spec.person.number("refraction_d", "right") if own.spec.person else np.nan
                )
        return out

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Test the table, alone and against the other corrections, and the artefact."""
        out = []
        by: dict[str, dict[str, Any]] = {}
        for row in size_rows(parts):
            if (row["observer"], row["stop_mm"]) == ("analytic", TABLE_MM):
                by.setdefault(row["camera"], {})[row["correction"]] = row
        for camera, rows in by.items():
            rule = f"{camera}: error of the size after the table, 95th percentile (%)"
            out.append(Finding.of("S1", KEY, rule, rows["table"]["p95"], "<= 1.2", _told(rows["table"])))
            ratio = min(rows[name]["p95"] for name in ("none", "cosine", "major axis")) / rows["table"]["p95"]
            rule = f"{camera}: smallest of none, cosine and major axis over the table"
            out.append(Finding.of("S2", KEY, rule, ratio, "> 1", "; ".join(f"{k} {_told(v)}" for k, v in rows.items())))
        for row in artefact_rows(parts):
            if row["cause"] == "whole":
                verdict = "compatible" if row["low_deg"] <= DREWES_DEG <= row["high_deg"] else "not"
                rule = f"{row['camera']}: mean artefact from .3 to 1000 cd/m2 (deg), {DREWES_DEG} in Drewes (2014)"
                text = f"{verdict}: interval {row['low_deg']:.2f} to {row['high_deg']:.2f}"
                out.append(Finding.of("S3", KEY, rule, row["mean_deg"], "none", text))
                rule = f"{row['camera']}: directions spread, length of their mean unit vector"
                out.append(Finding.of("S4", KEY, rule, row["concentration"], "< 0.8"))
            if row["cause"] == "optics":
                rule = f"{row['camera']}: the optics' share of the part that depends on direction"
                text = f"95 % interval {row['share_low']:.2f} to {row['share_high']:.2f}"
                out.append(Finding.of("S5", KEY, rule, row["share"], "> 0.5", text))
        return out

    def tables(self, parts: Sequence[ModelResults]) -> dict[str, Any]:
        """Return sizes over gaze, sizes straight ahead, and artefacts from the lowest to the highest luminance."""
        return {"sizes": size_rows(parts), "straight_ahead": straight_rows(parts), "artefacts": artefact_rows(parts)}

    def text(self, summary: Mapping[str, Any]) -> list[str]:
        """Format one line per size and artefact."""
        return [line_of(row) for name in ("sizes", "artefacts") for row in summary.get(name, ())]


def _without_refraction(eye: EyeModel) -> EyeModel:
    return replace(eye, front_indices=(1.0,) * len(eye.front_indices))


def _told(row: Mapping[str, Any]) -> str:
    return f"{row['p95']:.2f} % ({row['low']:.2f} to {row['high']:.2f})"


def size_rows(parts: Sequence[ModelResults]) -> list[dict[str, Any]]:
    """Compute the errors (%) for each observer, camera, stop and correction; each half has the other half's table."""
    rows: list[dict[str, Any]] = []
    first: dict[tuple[str, str], Floats] = {}
    keys = dict.fromkeys(key for part in parts for key in part.more["sizes"])
    for observer, camera, mm in sorted(keys, key=lambda key: (key[:2], key[2] != TABLE_MM, key[2])):
        found = [one for part in parts if (one := part.more["sizes"].get((observer, camera, mm)))]
        if len(found) < 4:
            continue
        half, dimmed = np.arange(len(found)) % 2, np.sqrt(np.stack([one["cosine"] for one in found]))
        ratios = {name: np.stack([one[name] / one[name][0] for one in found]) for name in found[0] if name != "cosine"}
        errors = {"major axis": ratios.pop("major axis")}
        for measure, ratio in ratios.items():
            name = "" if measure == "root of area" else f"{measure}, "
            table = np.stack([np.nanmean(ratio[half != k], axis=0) for k in half])
            errors[f"{name}none"] = ratio
            errors[f"{name}cosine"] = ratio * dimmed[:, :1] / dimmed
            errors[f"{name}table"] = ratio / table
            if not name and mm != TABLE_MM:
                errors[f"table of {TABLE_MM:g} mm"] = ratio / first[observer, camera]
            first.setdefault((observer, camera), table)
        for name, one in errors.items():
            off = 100.0 * np.abs(one[:, 1:] - 1.0)
            low, high = resampled(off, _p95)
            rows.append({
                "observer": observer, "camera": camera, "stop_mm": mm, "correction": name, "people": len(off),
                "missing": int(np.isnan(off).sum()), "p50": float(np.nanmedian(off)), "p95": _p95(off), "low": low,
                "high": high,
            })  # fmt: skip
    return rows


def _p95(off: Floats) -> float:
    return float(np.nanpercentile(off, 95))


def straight_rows(parts: Sequence[ModelResults]) -> list[dict[str, Any]]:
    """Compare the size straight ahead with stop and entrance pupil, and the dependence on gaze with the refraction.

    The strength of a person's dependence is the slope of its s(g)/s(0) - 1 over the mean of all people.
    """
    people = [part.more for part in parts if "straight" in part.more]
    rows = []
    for camera, mm in people[0]["straight"] if len(people) > 3 else ():
        sizes = np.stack([one["sizes"]["analytic", camera, mm]["root of area"] for one in people])
        lost = np.nan_to_num(sizes / sizes[:, :1] - 1.0)
        strength = 100.0 * lost @ lost.mean(axis=0) / np.sum(lost.mean(axis=0) ** 2)
        fit = linregress([one["refraction_d"] for one in people], strength)
        half = float(student.ppf(0.975, len(people) - 2) * fit.stderr)
        row: dict[str, Any] = {"camera": camera, "stop_mm": mm}
        for name in ("stop", "entrance pupil"):
            row |= interval(np.array([one["straight"][camera, mm][name] for one in people]), f"over the {name}")
        rows.append(row | {"percent per dioptre": float(fit.slope), "half of its 95 % interval": half})
    return rows


def artefact_rows(parts: Sequence[ModelResults]) -> list[dict[str, Any]]:
    """Summarise the change of the gaze error from the lowest to the highest luminance, by camera and cause."""
    people = [part.more["artefacts"] for part in parts if "artefacts" in part.more]
    rows = []
    for camera in people[0] if len(people) > 1 else ():
        moved = {cause: np.stack([one[camera][cause] for one in people]) for cause in CAUSES}
        change = {cause: every[:, 0] - every[:, -1] for cause, every in moved.items()}
        pattern = {cause: d - np.nanmean(d, axis=2, keepdims=True) for cause, d in change.items()}
        for cause, every in moved.items():
            shifts = np.nanmean(every, axis=3)  # people, luminances, eyes, 2
            shift = shifts[:, 0] - shifts[:, -1]
            size = np.linalg.norm(shift, axis=2)
            ways = shift / size[..., None] * [[-1.0, 1.0], [1.0, 1.0]]  # nasal is to the left of the right eye
            vergence = shift[:, 0, 0] - shift[:, 1, 0]
            squares = np.stack([np.nansum(pattern[one] ** 2, axis=(1, 2, 3)) for one in (cause, "whole")], axis=1)
            low, high = resampled(squares, _share)
            lit = np.linalg.norm(shifts, axis=3).mean(axis=(0, 2)).tolist()
            rows.append({
                "camera": camera, "cause": cause, "people": len(people), **summary(size.mean(axis=1)),
                "least_deg": float(size.min()), "most_deg": float(size.max()), "by_luminance_deg": lit,
                **interval(np.abs(size[:, 0] - size[:, 1]), "sizes_differ"),
                **interval(vergence, "vergence"), "vergence_sd": float(vergence.std(ddof=1)),
                "nasal": float(np.mean(ways[..., 0] > 0)),
                "concentration": float(np.linalg.norm(ways.mean(axis=(0, 1)))),
                "pattern_deg": float(np.sqrt(np.nanmean(np.sum(pattern[cause] ** 2, axis=3)))),
                "share": _share(squares), "share_low": low, "share_high": high,
            })  # fmt: skip
    return rows


def _share(squares: Floats) -> float:
    return float(np.sqrt(squares[:, 0].sum() / squares[:, 1].sum()))
