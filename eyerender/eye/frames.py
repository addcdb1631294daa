"""Frames of spectacles and holders of inserts, as meshes of tubes in the frame of the unrotated eye."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from ..base.arrays import SPECTACLE_FRAME, Body, Floats, frozen, remembered
from ..base.spec import Side, Spec
from ..optics.surfaces import components
from .worn import FrameShape, WornLens

_AROUND, _SIDES, _STEPS = 144, 10, 12  # pieces along a rim, sides of a tube, pieces along a bar
_RISE = 0.25  # height of bridge and hinge above the middle of the lens, over its half height
# Chosen: how far the rim reaches before the edge of the lens, sizes of bars, and how temples spread.
_AHEAD_MM, _BRIDGE_MM, _BRIDGE_HALF_MM = 0.5, 8.0, (1.6, 1.2)
_TEMPLE_HALF_MM, _HINGE_MM, _TEMPLE_MM, _SPREAD_MM = (2.2, 0.8), 5.0, 110.0, 8.0


class SpectacleFrame(Spec):
    """Frame of spectacles: a rim along the outline of the lens, a bridge to the nose, and a temple to the ear."""

    rims: bool = Field(default=True, description="whether a rim runs around the lens")
    bridge: bool | None = Field(default=None, description="whether a bar runs to the other lens; default: on the head")
    temples: bool | None = Field(default=None, description="whether a bar runs to the ear; default: on the head")
    round: bool | None = Field(
        default=None, description="whether the rim is round on its outside, as a holder; default: on the rig"
    )
    rim_mm: Annotated[float, Field(gt=0, le=20)] = Field(
        default=2.5, description="smallest width of the rim, seen from the front"
    )
    depth_mm: Annotated[float, Field(gt=0, le=20)] = Field(
        default=4.0, description="depth of the rim along the axis of the lens"
    )
    albedo: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.08, description="albedo at the wavelength of the scene"
    )

    def shape(self, side: Side, *, on_rig: bool) -> FrameShape:
        """Fill in the defaults of spectacles, or of an insert's holder `on_rig`."""
        bridge, temples = (not on_rig if given is None else given for given in (self.bridge, self.temples))
        return FrameShape(
            rims=self.rims, bridge=bridge, temples=temples, round=on_rig if self.round is None else self.round,
            rim_mm=self.rim_mm, depth_mm=self.depth_mm, albedo=self.albedo, nasal=1.0 if side == "right" else -1.0,
        )  # fmt: skip


@remembered
def frame_body(lens: WornLens) -> Body | None:
    """Compute the mesh of a lens's frame in the frame of the unrotated eye; None without any part."""
    shape = lens.frame
    if shape is None:
        return None
    nasal, rise = shape.nasal, _RISE * lens.half_mm[1]
    side = np.sqrt(1.0 - _RISE**2) * lens.half_mm[0] + 0.5 * shape.rim_mm
    tubes = [_rim(lens, shape)] if shape.rims else []
    if shape.bridge:
        along = np.linspace(0.0, 1.0, _STEPS)
        path = np.column_stack([0.0 * along, nasal * (side + _BRIDGE_MM * along), rise + np.sin(0.5 * np.pi * along)])
        tubes.append(_bar(_placed(lens, shape, path), _BRIDGE_HALF_MM))
    if shape.temples:
        hinge = _placed(lens, shape, np.array([[0.0, -nasal * side, rise]]))[0]
        back = np.linspace(0.0, 1.0, _STEPS)
        out = _HINGE_MM * np.minimum(4.0 * back, 1.0) + _SPREAD_MM * back
        steps = np.column_stack([-_TEMPLE_MM * back**2, -nasal * out, 0.0 * back])
        tubes.append(_bar(hinge + steps, _TEMPLE_HALF_MM))
    if not tubes:
        return None
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in tubes)])
    vertices, normals, faces = zip(*tubes, strict=True)
    return Body(
        part=SPECTACLE_FRAME,
        vertices=frozen(np.concatenate(vertices)),
        normals=frozen(np.concatenate(normals)),
        faces=frozen(np.concatenate([f + start for f, start in zip(faces, starts[:-1], strict=True)]), np.int64),
        albedo=shape.albedo,
    )


_Tube = tuple[Floats, Floats, Floats]


def _placed(lens: WornLens, shape: FrameShape, points: Floats) -> Floats:
    """Transform points (n, 3) of the lens's axes to the eye's, with x from the middle of the rim's depth there."""
    aside = np.array([0.0, 1.0, 1.0])
    inside = (
        points
        * aside
        / np.maximum(1.0, np.hypot(points[:, 1] / lens.half_mm[0], points[:, 2] / lens.half_mm[1]))[:, None]
    )
    away, way = 100.0, lens.rotation[:, 0]
    start = lens.centre_mm + inside @ lens.rotation.T + away * way
    edge = away - lens.front.hit(components(start), components(np.broadcast_to(-way, start.shape)), True).distance
    return lens.centre_mm + points @ lens.rotation.T + (edge + _AHEAD_MM - 0.5 * shape.depth_mm)[:, None] * way


def _rim(lens: WornLens, shape: FrameShape) -> _Tube:
    """Return the rim between the outline and a larger ellipse, or a circle around it."""
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    half = np.array(lens.half_mm)
    outer = (np.full(2, half.max()) if shape.round else half) + shape.rim_mm
    turn = np.column_stack([np.cos(angle), np.sin(angle)])
    middle, across = (np.column_stack([0.0 * angle, k * turn]) for k in ((half + outer) / 2.0, (outer - half) / 2.0))
    along = np.broadcast_to(0.5 * shape.depth_mm * lens.rotation[:, 0], middle.shape)
    return _tube(_placed(lens, shape, middle), across @ lens.rotation.T, along, np.ones(_AROUND), closed=True)


def _bar(path: Floats, half_mm: tuple[float, float]) -> _Tube:
    """Return a bar with closed ends along points (n, 3), with its half height and half thickness."""
    up = np.array([0.0, 0.0, 1.0])
    across = np.cross(up, np.gradient(path, axis=0))
    across *= half_mm[1] / np.linalg.norm(across, axis=1, keepdims=True)
    ends = np.concatenate([[0], np.arange(len(path)), [len(path) - 1]])
    scale = np.ones(len(ends))
    scale[[0, -1]] = 0.0
    return _tube(path[ends], np.broadcast_to(half_mm[0] * up, path.shape)[ends], across[ends], scale, closed=False)


def _tube(path: Floats, u: Floats, v: Floats, scale: Floats, *, closed: bool) -> _Tube:
    """Return vertices, normals and faces of a tube: ellipses with half axes u and v (n, 3) around points (n, 3)."""
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    cosine, sine = np.cos(angle)[None, :, None], np.sin(angle)[None, :, None]
    a, b = u[:, None], v[:, None]
    vertices = path[:, None] + scale[:, None, None] * (cosine * a + sine * b)
    normals = cosine * a / np.sum(a * a, axis=2, keepdims=True) + sine * b / np.sum(b * b, axis=2, keepdims=True)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    rings = len(path)
    i, j = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(_SIDES), indexing="ij")
    one, two = (((i + k) % rings) * _SIDES for k in (0, 1))
    after = (j + 1) % _SIDES
    faces = np.stack([one + j, two + j, two + after, one + j, two + after, one + after], axis=-1).reshape(-1, 3)
    return vertices.reshape(-1, 3), normals.reshape(-1, 3), faces
