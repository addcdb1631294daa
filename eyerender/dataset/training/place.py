"""Pictures and all their labels, mirrored or moved together.

A mirrored picture shows the mirrored scene: with F = diag(-1, 1, 1) in the camera's frame and S = diag(1, -1, 1) in the
world (the median plane of the head is y = 0), points become S x, and the camera F R S, F t. A picture that is moved by
x' = s Q x + d is that of the camera A K Q^T, Q R, Q t with A = [s Q, d], Q being a rotation in the plane of the image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...base.arrays import Bools, Floats
from ...imaging.labels import moments_ellipse
from ...scene.parts import IRIS, PUPIL
from .item import ANGLES, ARRAYS, CAMERA_SPACE, ELLIPSES, PICTURES, RIG_SPACE, TrainingItem, person_names

_F, _S = np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, 1.0])
_SMOOTH = ("image", "noiseless")
Patch = tuple[int, int, int, int]
"""First and last column (exclusive) and first and last row of a rectangle of pixels."""


def mirrored(item: TrainingItem) -> TrainingItem:
    """Turn a picture left to right, with all labels: it is then that of the mirrored scene.

    Glints get the number of the lamp that stands at the mirrored place, where the rig is symmetric. Landmarks of lids
    run from temple to nose, and numbers of a person are anatomical, so they keep their order.
    """
    last = item.size[0] - 1.0
    parts = {part: _mirrored(part, value, last) for part, value in item.parts.items()}
    if "glints" in parts and item.lamps is not None:
        parts["glints"][item.lamps] = parts["glints"][: len(item.lamps)].copy()
    mask = None if item.mask is None else item.mask[:, ::-1]
    return replace(item, parts=parts, mask=mask, mirrored=not item.mirrored)


def _mirrored(part: str, value: Any, last: float) -> Any:
    if part in PICTURES:
        return value[:, ::-1] * _F.astype(value.dtype) if part == "normals" else value[:, ::-1]
    if part in ELLIPSES or part in ("glints", "lids"):
        out = value.copy()
        out[..., 0] = last - value[..., 0]
        if part in ELLIPSES:
            out[4] = -value[4] % np.pi
        return out
    if part in CAMERA_SPACE or part in RIG_SPACE:
        return value * (_F if part in CAMERA_SPACE else _S)
    if part in ANGLES:
        return value * [-1.0, 1.0]
    if part == "eye":
        return np.array(1 - value)
    if part == "person":  # the right pupil's diameter less the left one's
        return np.where(np.array(person_names()) == "anisocoria_mm", -value, value)
    if part == "camera":
        K, k = value["K"].copy(), value["distortion"].copy()
        K[0, 2] = last - K[0, 2]
        k[_tangential(value)[0]] *= -1.0
        return {**value, "K": K, "R": _F[:, None] * value["R"] * _S, "t_mm": _F * value["t_mm"], "distortion": k}
    return value


def _tangential(camera: Mapping[str, Any]) -> list[int]:
    """Return the places of p2 and p1, which are a vector in the plane of the image, among the coefficients."""
    return [5, 4] if camera["fisheye"] else [3, 2]


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Placement of a picture on a canvas: x' = s Q x + d, in px with pixel centres at integers."""

    scale: float  # s
    turn_rad: float  # angle of Q, from +x towards +y (clockwise on the screen)
    offset: Floats  # d (2,)
    size: tuple[int, int]  # (width, height) of the canvas
    patches: tuple[Patch, ...] = ()  # rectangles of the canvas that are covered

    @classmethod
    def about(
        cls, centre: Floats, target: Floats, *, scale: float, turn_rad: float, size: tuple[int, int]
    ) -> Placement:
        """Create the placement that brings a place (2,) of the picture to a place (2,) of the canvas."""
        found = cls(scale=scale, turn_rad=turn_rad, offset=np.zeros(2), size=size)
        return replace(found, offset=target - found.moved(centre))

    @classmethod
    def fit(cls, own: tuple[int, int], size: tuple[int, int]) -> Placement:
        """Create the placement that shows a whole picture of a size (width, height) as large as possible."""
        scale = min(w / n for w, n in zip(size, own, strict=True))
        beside = np.floor((np.array(size) - scale * np.array(own)) / 2 + 1e-9)  # whole pixels
        return cls(scale=scale, turn_rad=0.0, offset=beside + 0.5 * (scale - 1.0), size=size)

    @cached_property
    def rotation(self) -> Floats:
        """Q (2, 2)."""
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.array([[c, -s], [s, c]])

    def moved(self, xy: Floats) -> Floats:
        """Return places (..., 2) of the picture on the canvas."""
        return np.asarray(self.scale * (xy @ self.rotation.T) + self.offset)

    def turned(self, vectors: Floats) -> Floats:
        """Turn vectors (..., 3) of the camera's frame."""
        return np.concatenate([vectors[..., :2] @ self.rotation.T, vectors[..., 2:]], axis=-1)

    def shows(self, x: Floats, y: Floats) -> Bools:
        """Return which places of the canvas are on it and not covered by a patch."""
        (width, height), seen = self.size, np.isfinite(x)
        seen &= (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        for left, right, top, bottom in self.patches:
            seen &= ~((x >= left - 0.5) & (x < right - 0.5) & (y >= top - 0.5) & (y < bottom - 0.5))
        return np.asarray(seen)


def placed(item: TrainingItem, at: Placement) -> TrainingItem:
    """Move a picture with all labels; what is cut off or covered counts as unseen."""
    out = replace(_cut(item, at), size=at.size, mask=None)
    parts = {part: _placed(part, value, at) for part, value in out.parts.items()}
    if "glints" in parts:
        glints = parts["glints"]
        glints[:, 2] *= at.shows(glints[:, 0], glints[:, 1])
    return replace(out, parts=parts)


def _cut(item: TrainingItem, at: Placement) -> TrainingItem:
    """Compute visible shares and ellipses from the pixels that remain, in px of the picture before it is moved."""
    if item.mask is None:
        return item
    eye = (item.mask == PUPIL) | (item.mask == IRIS)
    rows, columns = (np.flatnonzero(eye.any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        return item
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    v, u = np.arange(rows[0], rows[-1] + 1)[:, None], np.arange(columns[0], columns[-1] + 1)
    x, y = (at.scale * (q[0] * u + q[1] * v) + d for q, d in zip(at.rotation, at.offset, strict=True))
    own = item.mask[box] * eye[box]
    kept = own * at.shows(x, y)
    before, after = ([np.count_nonzero(mask == part) for part in (PUPIL, IRIS)] for mask in (own, kept))
    if before == after:
        return item
    share = np.array(after) / np.maximum(before, 1)
    parts = dict(item.parts)
    for part, inside in (("visible_pupil", kept == PUPIL), ("visible_iris", kept > 0)):
        if part in parts:
            found = moments_ellipse(inside, (columns[0], rows[0], *kept.shape[::-1]))
            none = found["centre_px"] is None
            numbers = [np.nan] * 5 if none else [*found["centre_px"], *found["semi_axes_px"], found["angle_rad"]]
            parts[part] = np.array(numbers)
    if "visible_fraction" in parts:
        parts["visible_fraction"] = parts["visible_fraction"] * share
    return replace(item, parts=parts, shown=item.shown * share)


def _placed(part: str, value: Any, at: Placement) -> Any:
    if part in PICTURES:
        turned = at.turned(value).astype(value.dtype) if part == "normals" and at.turn_rad else value
        empty = np.nan if part in ARRAYS else 0
        out = warped(turned, at, smooth=part in _SMOOTH, empty=empty)
        for left, right, top, bottom in at.patches if part not in _SMOOTH and part != "amodal_mask" else ():
            out[top:bottom, left:right] = empty
        return out
    if part in ELLIPSES:
        angle = (value[4] + at.turn_rad) % np.pi
        return np.array([*at.moved(value[:2]), *(at.scale * value[2:4]), angle])
    if part in ("glints", "lids"):
        return np.concatenate([at.moved(value[..., :2]), value[..., 2:]], axis=-1)
    if part in CAMERA_SPACE:
        return at.turned(value)
    return _moved_camera(value, at) if part == "camera" else value


def _moved_camera(camera: Mapping[str, Any], at: Placement) -> dict[str, Any]:
    """Return the camera that takes the moved picture; with pixels that are not square, a turn gives its K a skew."""
    Q, A = np.eye(3), np.eye(3)
    Q[:2, :2], A[:2, :2], A[:2, 2] = at.rotation, at.scale * at.rotation, at.offset
    across = np.array([-1.0 if camera["mirrored"] else 1.0, 1.0, 1.0])
    own = across[:, None] * Q * across  # x of the camera runs the other way behind a mirror
    k, p = camera["distortion"].copy(), _tangential(camera)
    k[p] = at.rotation @ k[p]
    return {**camera, "K": A @ camera["K"] @ Q.T, "R": own @ camera["R"], "t_mm": own @ camera["t_mm"], "distortion": k}


def warped(picture: NDArray[Any], at: Placement, *, smooth: bool, empty: float = 0) -> NDArray[Any]:
    """Resample a picture (h, w) or (h, w, channels): bilinear with antialiasing, or the nearest pixel."""
    if picture.ndim == 3:
        layers = [warped(picture[..., k], at, smooth=smooth, empty=empty) for k in range(picture.shape[2])]
        return np.stack(layers, axis=-1)
    own = picture.shape[::-1]
    method = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    image = Image.fromarray(np.ascontiguousarray(picture))
    if smooth and at.scale < 1:
        image = image.resize([max(1, round(at.scale * n)) for n in own], Image.Resampling.BILINEAR)
    reduced = np.array(image.size) / own
    # Pillow has pixel centres at halves.
    back = (reduced / at.scale)[:, None] * at.rotation.T
    start = reduced * 0.5 - back @ (at.offset + 0.5)
    numbers = (*back[0], start[0], *back[1], start[1])
    if image.size == at.size and np.allclose(numbers, (1, 0, 0, 0, 1, 0), rtol=0, atol=1e-9):
        return np.array(image)
    return np.array(image.transform(at.size, Image.Transform.AFFINE, numbers, method, fillcolor=empty))
