"""Parts of one picture for training: pixels, and labels in px of the picture, as NumPy arrays.

Labels keep their conventions (docs/formats.md) and are nan where they are unknown. `TrainingItem.valid` says which of
them mean anything: those of the pupil and the gaze do not while under a tenth of the pupil shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...base.arrays import Bools, Bytes, Floats, Ints
from ...base.errors import InputError
from ...base.storage.files import parse_json
from ...optics.transforms import rotated
from ...population.people import SOLVED
from ...population.table import default_table
from ...region.mesh import LID_MARKS
from ...rig.camera import PinholeCamera
from ...rig.mount import Mount
from ...scene.observation import EYES

_NEAR_MM = 1.0  # farther than tolerances of assembly
_NEAR = 0.25  # of the distance between neighbouring lamps


def rig_pose(line: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return the pose R (3, 3), t (3,) mm of a picture's rig in the world, x_world = R x_rig + t."""
    pose = line.get("rig_pose")
    if pose is not None:  # includes the mount
        return Rotation.from_rotvec(pose["rotation_rad"]).as_matrix(), np.array(pose["translation_mm"], dtype=float)
    text = line["parameters"]["scene_json"]
    mount = parse_json(text, path="scene_json")["rig"].get("mount") if '"mount"' in text else None
    return (np.eye(3), np.zeros(3)) if mount is None else Mount.from_mapping(mount).motion()


def mirrored_lamps(line: Mapping[str, Any]) -> Ints | None:
    """Return the number (n,) that each lamp of a rig has in the mirrored picture, or None without such a symmetry.

    A rig for both eyes is symmetric about the median plane of the head: a lamp of the left eye becomes the one of the
    right eye. A rig for one eye is symmetric about the plane of the camera's axis and its vertical.
    """
    lights = np.array(line["labels"]["lights_mm"], dtype=float)
    R, t = rig_pose(line)
    camera = PinholeCamera.from_labels(line["labels"]["camera"])
    found = partners((lights - t) @ R, 1)
    return partners(rotated(camera.sensor_axes, lights) + camera.sensor_offset, 0) if found is None else found


def partners(points: Floats, axis: int) -> Ints | None:
    """Return which of the points (n, 3) mm is the mirror image of each at the plane across an axis; None without one.

    A lamp may be off by 1 mm, and by a quarter of the smallest distance between two lamps.
    """
    between = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(between, np.inf)
    limit = min(_NEAR_MM, _NEAR * float(between.min(initial=np.inf)))
    away = np.linalg.norm(points[:, None] * np.where(np.arange(3) == axis, -1.0, 1.0) - points, axis=-1)
    nearest = away.argmin(axis=1) if len(points) else np.zeros(0, dtype=int)
    own = np.arange(len(points))
    return nearest if np.all(away[own, nearest] <= limit) and np.array_equal(nearest[nearest], own) else None


PICTURES = {
    "image": "images",
    "noiseless": "noiseless",
    "mask": "masks",
    "amodal_mask": "amodal_masks",
    "annotated_mask": "as_annotated",
    "highlight_mask": "highlights",
    "lens_reflection_mask": "lens_reflections",
    "instance_mask": "instances",
    "depth": "depth",
    "normals": "normals",
    "iris_coordinates": "iris_coordinates",
}
"""Part -> kind of picture of a folder."""
ARRAYS = ("depth", "normals", "iris_coordinates")
ELLIPSES = {
    "pupil": ("pupil", "amodal"),
    "iris": ("iris", "amodal"),
    "visible_pupil": ("pupil", "visible"),
    "visible_iris": ("iris", "visible"),
}
"""Part -> keys of the ellipse in the labels."""
_CENTRES = ("globe_centre_mm", "cornea_centre_mm", "pupil_centre_mm")
CAMERA_SPACE: dict[str, str | tuple[str, ...]] = {
    "gaze": "line_of_sight",
    "optic_axis": "optic_axis",
    "centres_mm": _CENTRES,
}
RIG_SPACE: dict[str, str | tuple[str, ...]] = {
    "gaze_rig": "line_of_sight",
    "optic_axis_rig": "optic_axis",
    "centres_rig_mm": _CENTRES,
}
"""Part -> keys of vectors in the frame of the camera, and of the rig."""
ANGLES = {"gaze_deg": "line_of_sight", "optic_axis_deg": "optic_axis"}
LABELS = (
    *(*ELLIPSES, "visible_fraction", "pupil_mm", "glints", "lids", "lid_opening"),
    *(*CAMERA_SPACE, *RIG_SPACE, *ANGLES, "eye", "person"),
)
"""Parts that have a validity."""
PARTS = (*PICTURES, *LABELS, "camera", "line")
LEAST_SHOWN = 0.1
"""Share of the pupil or the iris that must show, so that its labels are valid."""

PixelsOf = Callable[[str], NDArray[Any] | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingItem:
    """One picture with labels."""

    parts: dict[str, Any]  # the requested parts by name; pictures are (h, w) or (h, w, channels)
    size: tuple[int, int]  # (width, height) px
    # (2,) visible share of pupil and iris. What lies outside the picture or under a patch is not visible.
    shown: Floats
    there: bool = True  # whether the picture shows an eye, open or shut
    mask: Bytes | None = None  # (h, w) visible parts of the eye, needed where a part of the picture may be cut off
    lamps: Ints | None = None  # (n,) number that each lamp has in the mirrored picture; None if it keeps its own
    mirrored: bool = False  # whether picture and labels are mirrored

    def valid(self) -> dict[str, Bools]:
        """Return which labels mean anything, by part: a flag for an ellipse, a vector, a place or a plain number."""
        return {part: self._valid(part, self.parts[part]) for part in LABELS if part in self.parts}

    def _valid(self, part: str, value: Any) -> Bools:
        known = np.isfinite(value)
        pupil, iris = self.shown >= LEAST_SHOWN
        if part in ("glints", "lids"):
            return self.inside(value[..., :2])
        if part == "pupil_mm":
            known &= pupil
        elif part not in ("eye", "visible_fraction", "lid_opening", "person"):
            known = known.all(axis=-1)
            if part.startswith("centres"):
                known &= [True, True, pupil]
            elif not part.startswith("visible"):
                known &= iris if part == "iris" else pupil
        return np.asarray(known & self.there)

    def inside(self, xy: Floats) -> Bools:
        """Return which places (..., 2) lie in the picture; nan does not."""
        return np.asarray(((xy >= -0.5) & (xy < np.array(self.size) - 0.5)).all(axis=-1))


def part_of(part: str, line: Mapping[str, Any], picture: PixelsOf, *, linear: bool, lights: int | None) -> Any:
    """Read one of `PARTS` of a picture from its line (`eyerender/image/5`) and its pixels by kind of picture.

    `linear` undoes the camera's gamma; `lights` is the number of rows of `glints`, by default that of the rig's lamps.
    Raises KeyError if there is no such picture, or the line lacks a key; InputError if the rig has more lamps than
    `lights`.
    """
    if part in ("image", "noiseless"):
        gamma = float(line.get("gamma") or 1.0) if linear else 1.0
        return _shares(pixels_of(PICTURES[part], picture), line["bit_depth"], gamma)
    if part in PICTURES:
        return pixels_of(PICTURES[part], picture)
    if part == "glints":
        return _glints(line, lights)
    return line if part == "line" else _label(part, line)


def pixels_of(kind: str, picture: PixelsOf) -> NDArray[Any]:
    """Return the pixels of a kind of picture; raise `KeyError` where there are none."""
    pixels = picture(kind)
    if pixels is None:
        raise KeyError(kind)
    return pixels


def _shares(pixels: NDArray[Any], bit_depth: int, gamma: float) -> NDArray[np.float32]:
    """Convert counts to shares of the full scale, to the power of a gamma."""
    values = np.array(pixels, dtype=np.float32)
    if pixels.dtype.kind == "u":
        values /= 2**bit_depth - 1
        values = values if gamma == 1 else values**gamma
    return values


def _label(part: str, line: Mapping[str, Any]) -> Any:
    """Return a label of the eye or the camera."""
    labels = line["labels"]
    if part in ELLIPSES:
        return _ellipse(line, *ELLIPSES[part])
    if part == "camera":
        return _camera(line)
    if part == "lids":
        margins = labels["lid_margins_px"]
        if margins is None:
            return np.full((2, LID_MARKS, 2), np.nan)
        return np.array([margins["upper"], margins["lower"]], dtype=float) - _corner(line)
    if part == "eye":
        return np.array(EYES.index(line["records"][0]["eye"]))
    if part == "visible_fraction":
        return np.array([labels[of]["visible_fraction"] for of in ("pupil", "iris")], dtype=float)
    if part == "pupil_mm":
        return np.array([labels["pupil"][f"{of}_diameter_mm"] for of in ("entrance", "stop")], dtype=float)
    if part == "lid_opening":
        opening = labels.get("lid_opening") or {}
        return np.array([opening.get("mm"), opening.get("share")], dtype=float)
    if part == "person":
        person = line["parameters"].get("person") or {}
        return np.array([person.get(name) for name in person_names()], dtype=float)
    return _in_space(part, line)


def _in_space(part: str, line: Mapping[str, Any]) -> Floats:
    """Return vectors (..., 3) in the frame of the camera or the rig, or angles (2,); nan without an eye."""
    space, there = line["labels"]["space"], line["labels"].get("eye_present", True)
    names = CAMERA_SPACE.get(part) or RIG_SPACE.get(part) or ANGLES[part]
    own = space["camera" if part in CAMERA_SPACE else "world"]
    vectors = np.array(own[names] if isinstance(names, str) else [own[name] for name in names], dtype=float)
    vectors = vectors if there else np.full_like(vectors, np.nan)
    if part in CAMERA_SPACE:
        return vectors
    R, t = rig_pose(line)
    x, y, z = ((vectors - t if vectors.ndim == 2 else vectors) @ R).T
    if part in RIG_SPACE:
        return np.stack([x, y, z], axis=-1)
    return np.degrees([np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))])


def _corner(line: Mapping[str, Any]) -> Floats:
    return np.array([line["window_px"]["x0"], line["window_px"]["y0"]], dtype=float)


def _ellipse(line: Mapping[str, Any], part: str, kind: str) -> Floats:
    """Return centre, semi-axes (px of the picture) and angle (5,) of an outline; nan if there is none."""
    found = line["labels"][part][kind]
    if found["centre_px"] is None:
        return np.full(5, np.nan)
    return np.array([*(found["centre_px"] - _corner(line)), *found["semi_axes_px"], found["angle_rad"]])


def _glints(line: Mapping[str, Any], lights: int | None) -> Floats:
    """Return places of the glints in px of the picture and whether they are visible (lights, 3); nan without a glint.

    Where the lamp's centre has no reflection, the place is that of the part of the lamp that has one.
    """
    labels, corner = line["labels"], _corner(line)
    count = len(labels["lights_mm"])
    if lights is not None and count > lights:
        raise InputError(f"must be >= {count}, the number of the lamps of a rig", path="lights")
    out = np.full((count if lights is None else lights, 3), np.nan)
    for glint in labels["glints"]:
        place = glint["xy_px"] or glint["spot_xy_px"]
        if place is not None:
            out[glint["light"]] = [*(place - corner), float(glint["visible"])]
    return out


def _camera(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return the camera, with K for px of the picture, and 8 coefficients of distortion."""
    own = PinholeCamera.from_labels(line["labels"]["camera"])
    K = own.K.copy()
    K[:2, 2] -= _corner(line)
    # Five coefficients are the rational model's without its denominator.
    missing = np.full(8 - len(own.distortion), np.nan if own.is_fisheye else 0.0)
    return {
        "index": int(line["parameters"]["camera"]),
        "K": K,
        "R": np.array(own.R),
        "t_mm": np.array(own.t),
        "distortion": np.concatenate([own.distortion, missing]),
        "fisheye": own.is_fisheye,
        "mirrored": own.mirrored,
    }


@cache
def person_names() -> tuple[str, ...]:
    """Return the names of the numbers in the part `person`."""
    table = default_table()
    pupil = f"entrance_pupil_at_{table.constant('luminance_cd_m2'):g}_cd_m2_mm"
    return (*(name.replace(".", "_") for name in table.quantities), *SOLVED, pupil)
