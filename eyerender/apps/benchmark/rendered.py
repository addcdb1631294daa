"""Read folders of images that this package made: rendered ones (docs/formats.md), and ideal ones."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import WRONG, InputError
from ...base.storage.files import inside, read_json
from ...base.storage.jsonlines import JsonLines
from ...folders.imagefolder import DATASET, METADATA, ImageEntry, ImageFolder
from ...optics.ellipse import Ellipse
from ...rig.camera import PinholeCamera
from ...rig.distortion import distortion_data
from ...rig.rig import RigGeometry
from ...scene import Scene
from ...scene.observation import Observations
from ...scene.spec import SceneSpec
from .conditions import of_events, of_scene
from .glintlabels import TrueGlint
from .hints import NO_HINTS
from .labelled import BenchImage, factors_of

IDEAL_SCHEMA = "eyerender/ideal-images/1"
# Human pupils are 2 to 8 mm wide, the cornea magnifies them by up to 1.2, and tilt foreshortens them.
_RADIUS_MM = (0.6, 5.0)


def rendered_images(folder: Path, eye_error_mm: float) -> list[BenchImage]:
    """Read a rendered folder; `eye_error_mm` as in `BenchOptions`.

    Raises:
        InputError: the folder cannot be read, or an image does not show exactly one eye.
    """
    images = ImageFolder.load(folder)
    truth = images.truth()
    scene_rig = _rig_of(images)
    out = []
    for k, entry in enumerate(images):
        count = len(entry.records)
        if count != 1:
            raise InputError(
                f"shows {count} eyes; the benchmark needs images of one eye",
                source=str(folder / METADATA),
                path=f"line {k + 1}",
            )
        # There is one record per image, so an image's row in the truth is its number.
        try:
            hints = _hints(entry, truth, k, scene_rig, eye_error_mm)
            out.append(replace(_rendered(entry, truth, k), hints=hints))
        except WRONG as error:
            reason = f"has labels that cannot be used ({type(error).__name__}: {error})"
            raise InputError(reason, source=str(folder / METADATA), path=f"line {k + 1}") from None
    return out


def _rendered(entry: ImageEntry, truth: Observations, row: int) -> BenchImage:
    image = entry.image()
    x0, y0, width, height = entry.window
    corner = np.array([x0, y0], dtype=np.float64)
    labels, lids = entry.labels, entry.labels.get("lid_margins_px") or {}
    pupil, glints = truth.pupil, truth.glints
    visible = _visible(labels)
    there = bool(pupil.ok[row] and pupil.in_image[row]) and visible != 0.0
    ellipse, outline = None, np.zeros((0, 2))
    if there:
        ellipse = Ellipse(pupil.centre_px[row] - corner, pupil.semi_axes_px[row], float(pupil.angle_rad[row]))
        outline = pupil.points_px[row] - corner
        outline = outline[np.isfinite(outline).all(axis=-1)]
        if len(outline) < 6:
            outline = ellipse.points(120)
    shown = []
    hidden = []
    shares = {g["light"]: _visible_share(g) for g in labels.get("glints") or []}
    for j in np.flatnonzero(glints.ok[row] & glints.in_image[row]):
        x, y = glints.xy_px[row, j] - corner
        light = int(glints.light[row, j])
        share = shares.get(light, 1.0)
        if share == 0.0:
            hidden.append((float(x), float(y)))
        elif -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5:
            shown.append(TrueGlint(light, (float(x), float(y)), share))
    factors: dict[str, float] = {}
    azimuth, elevation = float(truth.pose.azimuth_rad[row]), float(truth.pose.elevation_rad[row])
    if math.isfinite(azimuth + elevation):
        factors["gaze_deg"] = math.degrees(math.acos(max(-1.0, min(1.0, math.cos(azimuth) * math.cos(elevation)))))
    return BenchImage(
        name=str(entry.line["file_name"]),
        path=entry.path,
        bit_depth=int(entry.line.get("bit_depth") or 8 * image.itemsize),
        size=(width, height),
        pupil=ellipse,
        outline_px=outline,
        visible=visible,
        glints=tuple(shown),
        factors=factors | factors_of(ellipse, visible),
        subject="" if entry.line.get("subject") is None else str(entry.line["subject"]),
        iris=_iris(labels, corner),
        lids_px=tuple(np.asarray(lids[lid], dtype=np.float64).reshape(-1, 2) - corner for lid in sorted(lids)),
        mask_path=entry.mask_path,
        conditions=tuple(of_scene(entry.line, ellipse, corner) | of_events(entry.records[0])),
        hidden_glints_px=tuple(hidden),
        recording=f"{entry.line.get('subject')} {truth.index.camera[row]} {truth.index.eye[row]}",
        time_s=None if entry.line.get("time_s") is None else float(entry.line["time_s"]),
    )


def _visible_share(glint: Mapping[str, Any]) -> float:
    """Return the visible share of a glint's label, which older folders lack in part."""
    share = glint.get("visible_share")
    return (1.0 if share is None else float(share)) if glint.get("visible", True) else 0.0


def _iris(labels: Mapping[str, Any], corner: Floats) -> Ellipse | None:
    outline = (labels.get("iris") or {}).get("amodal")
    if not isinstance(outline, dict) or outline.get("status") != "ok":
        return None
    centre = np.asarray(outline["centre_px"], dtype=np.float64) - corner
    return Ellipse(centre, outline["semi_axes_px"], outline["angle_rad"])


def _visible(labels: Mapping[str, Any]) -> float | None:
    value = (labels.get("pupil") or {}).get("visible_fraction")
    return float(value) if value is not None else None


def _hints(
    entry: ImageEntry, truth: Observations, row: int, scene_rig: RigGeometry | None, eye_error_mm: float
) -> dict[str, Any]:
    """Return the information given to an extractor, which never includes the truth.

    It consists of the rig, an approximate position of the eye, and the resulting range of pupil sizes. The position's
    random error is derived from the image's name.
    """
    line, corner = entry.line, np.array(entry.window[:2], dtype=np.float64)
    seed = int.from_bytes(hashlib.sha256(str(line["file_name"]).encode()).digest()[:8], "big")
    error_mm = eye_error_mm * np.random.default_rng(seed).standard_normal(3)
    eye_mm = truth.index.eye_position_mm[row] + truth.index.head_mm[row] + error_mm
    camera, lights = _camera_and_lights(line, int(truth.index.camera[row]), scene_rig)
    hints = NO_HINTS | {"polarity": "dark", "gamma": float(line.get("gamma") or 1.0)}
    if camera is None or not np.isfinite(eye_mm).all():
        return hints
    scale = camera.scale_at(eye_mm)
    K = np.array(camera.K)
    K[:2, 2] -= corner
    return hints | {
        "radius_px": [max(_RADIUS_MM[0] * scale, 3.0), max(_RADIUS_MM[1] * scale, 8.0)],
        "rig": {
            "K": K.tolist(),
            "R": camera.R.tolist(),
            "t_mm": camera.t.tolist(),
            "distortion": distortion_data(camera.distortion),
            **({"mirrored": True} if camera.mirrored else {}),
            "lights_mm": lights.tolist(),
            "eye_mm": eye_mm.tolist(),
            "eye_sd_mm": eye_error_mm,
        },
    }


def _camera_and_lights(
    line: Mapping[str, Any], camera: int, rig: RigGeometry | None
) -> tuple[PinholeCamera | None, Floats]:
    """Return camera and lights of an image from its labels if they are there, else from the scene."""
    labels = line.get("labels") or {}
    own, lights = labels.get("camera"), labels.get("lights_mm")
    if own and lights is not None:
        return PinholeCamera.from_labels(own), np.asarray(lights, dtype=np.float64).reshape(-1, 3)
    if rig is None or not 0 <= camera < len(rig.cameras):
        return None, np.zeros((0, 3))
    return rig.cameras[camera], np.array([light.position_mm for light in rig.lights]).reshape(-1, 3)


def _rig_of(folder: ImageFolder) -> RigGeometry | None:
    """Return the rig of the scene from which the folder was rendered; None for a dataset, whose images differ."""
    spec = folder.dataset.get("spec")
    if not isinstance(spec, dict) or folder.dataset.get("kind") == "dataset":
        return None
    source = str(folder.path / DATASET)
    return Scene.of(SceneSpec.from_mapping(spec, source=source), source=source).rig


def is_ideal(folder: Path) -> bool:
    """Return whether a folder holds ideal images."""
    try:
        return read_json(folder / DATASET, follow=False).get("schema") == IDEAL_SCHEMA
    except InputError:
        return False


def ideal_images(folder: Path) -> list[BenchImage]:
    """Read a folder of ideal images; InputError if a line is not a record of such an image, or there is none."""
    source = str(folder / METADATA)
    lines = JsonLines.index(folder / METADATA)
    out = []
    for k, line in enumerate(lines.read(range(len(lines)))):
        try:
            path = inside(folder, line["file_name"], source=source, path=f"line {k + 1}.file_name")
            out.append(_ideal(path, line["file_name"], line["records"][0], line["parameters"]))
        except WRONG:
            raise InputError("is not an image record", source=source, path=f"line {k + 1}") from None
    if not out:
        raise InputError("holds no images", source=source)
    return out


def _ideal(path: Path, name: str, record: Mapping[str, Any], said: Mapping[str, Any]) -> BenchImage:
    label, depth = record["pupil"], int(said["bit_depth"])
    if not 1 <= depth <= 32:
        raise ValueError("bit_depth")
    pupil = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"]) if label["status"] == "ok" else None
    visible = said.get("visible_fraction")
    if visible is None and not said["lid"]:
        visible = 1.0
    return BenchImage.read(
        name,
        path,
        pupil,
        visible=visible,
        bit_depth=depth,
        glints=tuple(TrueGlint(int(g["light"]), tuple(g["xy_px"])) for g in record["glints"] if g["status"] == "ok"),
        hints=NO_HINTS | {"polarity": said["polarity"]},
        known={key: float(said[key]) for key in ("noise_dn", "blur_px", "step_dn")},
    )
