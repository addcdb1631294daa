"""A labelled folder for benchmarks: images, true features in image coordinates, hints, and factors that vary.

Four kinds are read: folders that this package rendered (docs/formats.md), folders of ideal images, the user's own
labelled images (`own`), and public layouts (`layouts`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Bytes, Floats
from ...base.errors import InputError
from ...base.storage.files import inside, read_json
from ...base.storage.jsonlines import JsonLines
from ...folders.imagefile import read_any_image, read_image
from ...folders.imagefolder import DATASET, METADATA, ImageEntry, ImageFolder
from ...optics.ellipse import Ellipse
from ...rig.camera import PinholeCamera
from ...rig.rig import RigGeometry
from ...scene import Scene
from ...scene.observation import Observations
from ...scene.spec import SceneSpec
from .conditions import of_pixels, of_scene, of_shape, tags
from .glintlabels import TrueGlint, measured
from .hints import FolderHints
from .layouts import layout_of, read_layout, stated_gamma
from .own import Labelled, is_own, own_labels

IDEAL_SCHEMA = "eyerender/ideal-images/1"
# Human pupils are 2 to 8 mm wide, the cornea magnifies them by up to 1.2, and tilt foreshortens them.
_RADIUS_MM = (0.6, 5.0)
EYE_ERROR_MM = 5.0


@dataclass(frozen=True, slots=True)
class LabelledImage:
    """One image of one eye; positions are relative to the image, with pixel centres at integers.

    Attributes:
        name: name of the image.
        path: file.
        bit_depth: bits of the file.
        size: (width, height).
        pupil: None where the image shows none, or only its centre is known.
        outline_px: (n, 2) outline of the pupil.
        visible: visible share of the pupil; None if unknown.
        glints: glints that the image shows.
        hints: information given to extractors.
        known: noise (DN), blur (px) and step (DN), if the folder states them.
        factors: possible causes of an error, by name.
        subject: the person; if "" (unknown), each image counts as a separate subject.
        iris: outline of the iris; None if unknown.
        lids_px: (n, 2) margins of the lids, as far as they are known.
        mask_path: file of the classes of the pixels; None if unknown.
        hidden_glints_px: positions of glints that are hidden in the image.
        conditions: hard conditions (`conditions.CONDITIONS`).
        centre_px: (x, y) of a pupil of which only the centre is known.
        gamma_from: where the gamma of the hints comes from: the folder, an option (`given`), or nowhere (`assumed`).
    """

    name: str
    path: Path
    bit_depth: int
    size: tuple[int, int]
    pupil: Ellipse | None
    outline_px: Floats
    visible: float | None
    glints: tuple[TrueGlint, ...]
    hints: Mapping[str, Any]
    known: Mapping[str, float] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    gamma_from: str = "folder"
    subject: str = ""
    iris: Ellipse | None = None
    lids_px: tuple[Floats, ...] = ()
    mask_path: Path | None = None
    conditions: tuple[str, ...] = ()
    hidden_glints_px: tuple[tuple[float, float], ...] = ()
    centre_px: tuple[float, float] | None = None

    @property
    def shows_pupil(self) -> bool:
        """Whether the image shows a pupil, of which the ellipse or only the centre is known."""
        return self.pupil is not None or self.centre_px is not None

    def classes(self) -> Bytes | None:
        """Read the class of each pixel (0 skin, 1 sclera, 2 iris, 3 pupil, 4 a frame); None if unknown."""
        return None if self.mask_path is None else np.asarray(read_image(self.mask_path)[0], dtype=np.uint8)


def load_labelled(
    folder: str | Path,
    gamma: float | None = None,
    *,
    eye_error_mm: float = EYE_ERROR_MM,
    pupil_class: int | None = None,
) -> list[LabelledImage]:
    """Load every image of a folder.

    Args:
        folder: the folder.
        gamma: encoding gamma of images whose folder states none; None assumes 1.
        eye_error_mm: standard deviation, per axis, of the error of the eye position given to extractors.
        pupil_class: value of the pupil in masks of several classes.

    Raises:
        InputError: the folder is of another kind; an image is missing, has another size or does not show exactly one
            eye; or the folder states another gamma than `gamma`.
    """
    images = _load(Path(folder), eye_error_mm, pupil_class)
    out = []
    for image in images:
        image = _described(image)
        stated = float(image.hints["gamma"])
        if image.gamma_from == "assumed" and gamma is not None:
            image = replace(image, hints={**image.hints, "gamma": gamma}, gamma_from="given")
        elif gamma is not None and gamma != stated:
            raise InputError(f"{image.name} states a gamma of {stated:g}, not {gamma:g}", source="--gamma")
        out.append(image)
    return out


def _described(image: LabelledImage) -> LabelledImage:
    """Add measured properties of the glints, and the conditions that features and pixels show."""
    spots = np.array([g.xy_px for g in image.glints]).reshape(-1, 2)
    conditions = [set(image.conditions)]
    if image.centre_px is None:
        conditions.append(of_shape(image.pupil, image.visible, image.size, spots))
    glints, mask = image.glints, image.classes()
    if mask is not None or glints:
        grey = read_any_image(image.path)[0]
        conditions.append(of_pixels(grey, image.bit_depth, mask))
        glints = measured(glints, grey, image.bit_depth, image.pupil, mask)
    return replace(image, conditions=tags(*conditions), glints=glints)


def _load(path: Path, eye_error_mm: float, pupil_class: int | None) -> list[LabelledImage]:
    if _is_ideal(path):
        return _load_ideal(path)
    if is_own(path):
        return _with_hints(path, own_labels(path, pupil_class), None)
    layout = None if (path / DATASET).exists() else layout_of(path)
    if layout is not None:
        return _with_hints(path, read_layout(path, layout), stated_gamma(path))
    images = ImageFolder.load(path)
    truth = images.truth()
    scene_rig = _rig_of(images)
    out = []
    for k, entry in enumerate(images):
        count = len(entry.records)
        if count != 1:
            raise InputError(
                f"shows {count} eyes; the benchmark needs images of one eye",
                source=str(path / METADATA),
                path=f"line {k + 1}",
            )
        # There is one record per image, so an image's row in the truth is its number.
        image = _rendered(entry, truth, k)
        hints = _hints(entry, truth, k, scene_rig, eye_error_mm)
        out.append(replace(image, hints=hints))
    return out


def _with_hints(folder: Path, labels: Iterable[Labelled], gamma: float | None) -> list[LabelledImage]:
    """Yield images with the hints stated by the folder; `gamma` is that of its layout, if it states one."""
    told = FolderHints.load(folder)
    gamma = told.gamma or gamma
    hints, source = {**told.to_request(), "gamma": gamma or 1.0}, "assumed" if gamma is None else "folder"
    out = []
    for label in labels:
        image, depth, _ = read_any_image(label.path)
        pupil = None if label.visible == 0.0 else label.pupil
        more: dict[str, Any] = {"visible": label.visible, "glints": label.glints}
        found = _without_rig(label.name, label.path, (depth, image.shape), pupil, **more)
        found = replace(found, hints=hints, gamma_from=source, subject=label.subject, centre_px=label.centre_px)
        out.append(found)
    if not out:
        raise InputError("holds no labelled images", source=str(folder))
    return out


def _without_rig(
    name: str,
    path: Path,
    stored: tuple[int, tuple[int, ...]],
    pupil: Ellipse | None,
    *,
    visible: float | None = None,
    glints: tuple[TrueGlint, ...] = (),
    polarity: str = "auto",
    known: Mapping[str, float] | None = None,
) -> LabelledImage:
    """Return an image, with `stored` bit depth and shape, whose camera and lights are unknown."""
    bit_depth, (height, width) = stored
    size, outline = (width, height), np.zeros((0, 2)) if pupil is None else pupil.points(120)
    hints = {"polarity": polarity, "gamma": 1.0, "radius_px": None, "rig": None}
    factors = _ellipse_factors(pupil, visible)
    return LabelledImage(name, path, bit_depth, size, pupil, outline, visible, glints, hints, known or {}, factors)


def _rendered(entry: ImageEntry, truth: Observations, row: int) -> LabelledImage:
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
    return LabelledImage(
        str(entry.line["file_name"]),
        entry.path,
        int(entry.line.get("bit_depth") or 8 * image.itemsize),
        (width, height),
        ellipse,
        outline,
        visible,
        tuple(shown),
        {},
        {},
        factors | _ellipse_factors(ellipse, visible),
        subject=str(entry.line.get("subject", "")),
        iris=_iris(labels, corner),
        lids_px=tuple(np.asarray(lids[lid], dtype=np.float64).reshape(-1, 2) - corner for lid in sorted(lids)),
        mask_path=entry.mask_path,
        conditions=tuple(of_scene(entry.line, ellipse, corner)),
        hidden_glints_px=tuple(hidden),
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
    pupil = labels.get("pupil")
    value = pupil.get("visible_fraction") if isinstance(pupil, dict) else labels.get("pupil_visible_fraction")
    return float(value) if value is not None else None


def _ellipse_factors(pupil: Ellipse | None, visible: float | None) -> dict[str, float]:
    out: dict[str, float] = {}
    if pupil is not None:
        a, b = pupil.semi_axes_px
        x, y = pupil.centre_px % 1.0
        out = {"pupil_px": math.sqrt(a * b), "aspect": b / a, "phase_x": float(x), "phase_y": float(y)}
        if visible is not None:
            out["occlusion"] = 1.0 - visible
    return out


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
    hints: dict[str, Any] = {
        "polarity": "dark",
        "gamma": float(line.get("gamma") or 1.0),
        "radius_px": None,
        "rig": None,
    }
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
            "distortion": camera.distortion.tolist(),
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
        seen = PinholeCamera.of(own["K"], own["R"], own["t_mm"], tuple(own["resolution_px"]), own["distortion"])
        seen = replace(seen, mirrored=own.get("mirrored") is True)
        return seen, np.asarray(lights, dtype=np.float64).reshape(-1, 3)
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


def _is_ideal(folder: Path) -> bool:
    try:
        return read_json(folder / DATASET, follow=False).get("schema") == IDEAL_SCHEMA
    except InputError:
        return False


def _load_ideal(folder: Path) -> list[LabelledImage]:
    source = str(folder / METADATA)
    lines = JsonLines.index(folder / METADATA)
    out = []
    for k, line in enumerate(lines.read(range(len(lines)))):
        try:
            path = inside(folder, line["file_name"], source=source, path=f"line {k + 1}.file_name")
            out.append(_ideal(path, line["file_name"], line["records"][0], line["parameters"]))
        except InputError:
            raise
        except (ValueError, KeyError, TypeError, IndexError, AttributeError):
            raise InputError("is not an image record", source=source, path=f"line {k + 1}") from None
    if not out:
        raise InputError("holds no images", source=source)
    return out


def _ideal(path: Path, name: str, record: Mapping[str, Any], said: Mapping[str, Any]) -> LabelledImage:
    image, _ = read_image(path)
    label = record["pupil"]
    pupil = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"]) if label["status"] == "ok" else None
    visible = said.get("visible_fraction")
    if visible is None and not said["lid"]:
        visible = 1.0
    if visible == 0.0:
        pupil = None
    known = {"noise_dn": float(said["noise_dn"]), "blur_px": float(said["blur_px"]), "step_dn": float(said["step_dn"])}
    glints = tuple(TrueGlint(int(g["light"]), tuple(g["xy_px"])) for g in record["glints"] if g["status"] == "ok")
    more: dict[str, Any] = {"visible": visible, "glints": glints, "polarity": said["polarity"], "known": known}
    return _without_rig(name, path, (int(said["bit_depth"]), image.shape), pupil, **more)
