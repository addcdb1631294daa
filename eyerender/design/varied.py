"""Features of eyes as functions of the unknowns, with derivatives, in one batch of traces.

Derivatives are central differences of the analytic observer. Three kinds need no additional trace: a position of the
person acts like slippage, the depth of the rotation centre moves the turned eye by (M - I) e_x per millimetre, and the
pupil's shift with its size acts like a shift of its centre.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..analytic.features import View
from ..analytic.rays import glint_exits, pupil_exits
from ..base.arrays import Bools, Floats, Ints, Statuses, take_rows
from ..base.errors import InputError
from ..base.status import Status
from ..eye.batch import slices, stack_eyes, structure_of, take_eyes
from ..eye.model import EyeModel, RotationCentres, Stop
from ..eye.pose import Poses, rigid_motion
from ..optics.surfaces import Surface
from ..optics.surfaces_graph import Biconic
from ..optics.surfaces_quadric import Quadric
from ..optics.transforms import direction_of, normalize
from ..rig.rig import RigGeometry
from .unknowns import (
    ASPHERICITY,
    AZIMUTH,
    CENTRE,
    COUNT,
    DEPTH,
    ELEVATION,
    ELLIPTICITY,
    GAP,
    HARMONICS,
    KAPPA,
    MARGIN,
    POSITION,
    POSTERIOR,
    POSTERIOR_TORICITY,
    PUPIL,
    RADIUS,
    ROTATION,
    SHIFT,
    SLIPPAGE,
    TORICITY,
)

TRACED = np.array([AZIMUTH, ELEVATION, 3, 4, 5, RADIUS, ASPHERICITY, DEPTH, 15, 16, 17, 18, POSTERIOR, 33, 34])
STEPS = np.where(TRACED < PUPIL, 1e-4, 1e-3)
"""Steps of the central differences by the traced unknowns: angles in rad, lengths in mm, Q."""
_RAY_STEP = 1e-5
_TOGETHER = 240_000
"""Points refracted at once: the search for the few rays that the compiled solver misses has a high cost per call."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Views:
    """n views, each of one eye at one instant by one camera."""

    eyes: EyeModel  # p eyes of one structure, stacked
    person: Ints  # (n,) the eye of each view
    position_mm: Floats  # (n, 3) apex of the unrotated eye in the world, before slippage
    camera: Ints  # (n,) the camera
    rig: RigGeometry

    def __len__(self) -> int:
        return len(self.person)

    def take(self, rows: Ints | slice) -> Views:
        """Select views."""
        return replace(self, person=self.person[rows], position_mm=self.position_mm[rows], camera=self.camera[rows])

    @property
    def lights_mm(self) -> Floats:
        """Positions of the lights, (m, 3) mm."""
        return np.array([light.position_mm for light in self.rig.lights]).reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ModelFeatures:
    """Features of n views: outline (n, k, 2) px and glints (n, m, 2) px, and which exist and are on the sensor."""

    outline_px: Floats
    outline_ok: Bools
    glints_px: Floats
    glint_ok: Bools


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FeatureSlopes:
    """Features of n views with their derivatives with respect to the 35 unknowns."""

    images: ModelFeatures  # the features
    outline: Floats  # (n, k, 2, 35) derivatives, px per rad or mm; 0 for a missing point
    glints: Floats  # (n, m, 2, 35) derivatives, px per rad or mm
    outline_ok: Bools  # (n, k) whether a point is on the sensor, and its derivatives exist
    glint_ok: Bools  # (n, m) the same for glints


def stacked_eyes(eyes: Sequence[EyeModel]) -> EyeModel:
    """Stack eyes whose corneas have a radius and an asphericity.

    Raises:
        InputError: the eyes differ in structure, or a cornea is measured or tilted in a way that has neither.
    """
    if any(structure_of(eye) != structure_of(eyes[0]) for eye in eyes):
        raise InputError("are of different structures", path="eyes")
    stack = stack_eyes(eyes)
    for surface in stack.front:
        _ = radius_of(surface)
    return stack


def radius_of(surface: Surface) -> Floats:
    """Return the mean apex radius (n,) mm of corneal surfaces.

    Raises:
        InputError: the surface is neither a sphere, a conic nor a biconic.
    """
    if isinstance(surface, Biconic):
        return np.asarray(np.mean(surface.radii_mm, axis=-1))
    if isinstance(surface, Quadric) and (conic := surface.as_conic()) is not None:
        return conic[0]
    raise InputError("the cornea is not a sphere, conic or biconic, so it has no radius to vary", path="cornea")


def _scaled(surface: Surface, factor: Floats) -> Surface:
    """Multiply a surface's radii by a factor (n,)."""
    if isinstance(surface, Biconic):
        return replace(surface, radii_mm=surface.radii_mm * factor[:, None])
    assert isinstance(surface, Quadric)
    return replace(surface, vector=surface.vector * factor[:, None])


def _flattened(surface: Surface, change: Floats) -> Surface:
    """Add (n,) to a surface's conic constants."""
    if isinstance(surface, Biconic):
        return replace(surface, conic_constants=surface.conic_constants + change[:, None])
    assert isinstance(surface, Quadric)
    matrix = np.array(surface.matrix)
    matrix[:, 0, 0] += change
    return replace(surface, matrix=matrix)


def _toric(surface: Surface, change: Floats, handed: Floats) -> Surface:
    """Make a surface toric: apex radii R + t along the meridian a and R - t across it, `change` = (t cos 2a, t sin 2a).

    A conic becomes the quadric (1 + Q) x^2 + (1 - t_c / R) y^2 - 2 (t_s / R) y z + (1 + t_c / R) z^2 + 2 R x = 0.
    """
    if not np.any(change):
        return surface
    straight, oblique = change[:, 0], handed * change[:, 1]
    if isinstance(surface, Biconic):
        mean, own = np.mean(surface.radii_mm, axis=-1), 0.5 * (surface.radii_mm[..., 0] - surface.radii_mm[..., 1])
        sign = np.where(own < 0, -1.0, 1.0)
        size = sign * np.hypot(own + straight, oblique)
        angle = 0.5 * np.arctan2(sign * oblique, sign * (own + straight))
        turn = np.zeros((len(angle), 3, 3))
        turn[:, 0, 0], turn[:, 1, 1], turn[:, 2, 2] = 1.0, np.cos(angle), np.cos(angle)
        turn[:, 1, 2], turn[:, 2, 1] = -np.sin(angle), np.sin(angle)
        radii = np.stack([mean + size, mean - size], axis=-1)
        return replace(surface, radii_mm=radii, rotation=surface.rotation @ turn)
    assert isinstance(surface, Quadric)
    matrix, radius = np.array(surface.matrix), surface.vector[..., 0]
    matrix[:, 1, 1] -= straight / radius
    matrix[:, 2, 2] += straight / radius
    matrix[:, 1, 2] -= oblique / radius
    matrix[:, 2, 1] -= oblique / radius
    return replace(surface, matrix=matrix)


def _varied_stop(stop: Stop, theta: Floats) -> Stop:
    """Apply the stop's unknowns; an ellipticity stretches its plane along one axis and shrinks it across."""
    wanted = theta[:, PUPIL] / (2.0 * np.sqrt(np.prod(stop.semi_axes_mm, axis=-1)))
    centre = np.array(stop.centre_mm)
    centre[:, 0] -= theta[:, DEPTH]
    place = theta[:, CENTRE] + theta[:, SHIFT] * _widening(stop, theta)[:, None]
    centre[:, 1] += stop.handed * place[:, 0]
    centre[:, 2] += place[:, 1]
    straight, oblique = theta[:, ELLIPTICITY.start, None], (stop.handed * theta[:, ELLIPTICITY.start + 1])[:, None]
    rotation = np.array(stop.rotation)
    first, second = stop.rotation[:, :, 1], stop.rotation[:, :, 2]
    rotation[:, :, 1] = (1.0 + straight) * first + oblique * second
    rotation[:, :, 2] = (1.0 - straight) * second + oblique * first
    waves = max(stop.contour.shape[-1], HARMONICS[-1])
    contour = np.zeros((len(theta), 2, waves))
    contour[..., : stop.contour.shape[-1]] = stop.contour
    contour[:, :, np.array(HARMONICS) - 1] += np.swapaxes(theta[:, MARGIN].reshape(len(theta), -1, 2), 1, 2)
    axes = stop.semi_axes_mm * wanted[:, None]
    return replace(stop, centre_mm=centre, rotation=rotation, semi_axes_mm=axes, contour=contour)


def _outline_moves(stop: Stop, theta: Floats, count: int) -> Floats:
    """Compute how the outline's points move with each unknown of its shape and size, (n, count, 3, 35) mm.

    The three components are those of `CENTRE` and `DEPTH`: nasal, up, and backwards. A point of the outline moves in
    the image like one that the pupil's centre carries along, so that these derivatives need no traces.
    """
    varied = _varied_stop(stop, theta)
    angle = (2.0 * np.pi * np.arange(count) / count)[None]
    radius = varied.relative_radius(angle)
    y = ((stop.handed * varied.semi_axes_mm[:, 0])[:, None] * np.cos(angle) * radius)[..., None]
    z = (varied.semi_axes_mm[:, 1, None] * np.sin(angle) * radius)[..., None]
    first, second = stop.rotation[:, None, :, 1], stop.rotation[:, None, :, 2]
    offset = varied.boundary(count) - varied.centre_mm[:, None]
    out = np.zeros((len(theta), count, 3, COUNT))
    out[..., PUPIL] = offset / theta[:, PUPIL, None, None]
    out[..., ELLIPTICITY.start] = y * first - z * second
    out[..., ELLIPTICITY.start + 1] = stop.handed[:, None, None] * (y * second + z * first)
    for k, column in zip(HARMONICS, range(MARGIN.start, MARGIN.stop, 2), strict=True):
        out[..., column] = offset * (np.cos(k * angle) / radius)[..., None]
        out[..., column + 1] = offset * (np.sin(k * angle) / radius)[..., None]
    nasal, up, back = stop.handed[:, None, None] * out[:, :, 1], out[:, :, 2], -out[:, :, 0]
    return np.stack([nasal, up, back], axis=2)


def _widening(stop: Stop, theta: Floats) -> Floats:
    """Return the change (n,) mm of the pupil's diameter from that of the start."""
    return np.asarray(theta[:, PUPIL] - 2.0 * np.sqrt(np.prod(stop.semi_axes_mm, axis=-1)))


def varied_eyes(eye: EyeModel, theta: Floats) -> EyeModel:
    """Apply unknowns (n, 35) to an eye, giving a batch of n; line of sight, lens and fovea stay.

    The front of the cornea gets the radius R + dR. The surfaces behind it follow in proportion, and have a relative
    radius and a toricity of their own.
    """
    radius = radius_of(eye.front[0])
    factor = (radius + theta[:, RADIUS]) / radius
    behind = factor * (1.0 + theta[:, POSTERIOR])
    first = _flattened(_scaled(eye.front[0], factor), theta[:, ASPHERICITY])
    front = [_toric(first, theta[:, TORICITY], eye.stop.handed)]
    front += [_toric(_scaled(s, behind), theta[:, POSTERIOR_TORICITY], eye.stop.handed) for s in eye.front[1:]]
    return replace(
        eye, front=tuple(front), stop=_varied_stop(eye.stop, theta), rotation=_varied_centres(eye.rotation, theta)
    )


def _varied_centres(turns: RotationCentres, theta: Floats) -> RotationCentres:
    """Apply the unknowns of the rotation centres."""
    back = np.array([1.0, 0.0, 0.0])
    azimuth, elevation = theta[:, ROTATION] + theta[:, GAP] / 2.0, theta[:, ROTATION] - theta[:, GAP] / 2.0
    return RotationCentres(
        turns.azimuth_centre_mm - azimuth[:, None] * back,
        turns.elevation_centre_mm - elevation[:, None] * back,
        turns.torsion_centre_mm,
    )


def diameters_mm(eyes: EyeModel) -> Floats:
    """Compute the diameter (p,) mm of the circle with the pupil's area, for p eyes."""
    return np.asarray(2.0 * np.sqrt(np.prod(eyes.stop.semi_axes_mm, axis=-1)))


def images_of(views: Views, theta: Floats, boundary_points: int) -> ModelFeatures:
    """Trace the features of views with unknowns (n, 35)."""
    n, m, k = len(views), len(views.rig.lights), boundary_points
    outline, glints = np.full((n, k, 2), np.nan), np.full((n, m, 2), np.nan)
    outline_ok, glint_ok = np.zeros((n, k), dtype=bool), np.zeros((n, m), dtype=bool)
    for number in np.unique(views.camera):
        rows = np.flatnonzero(views.camera == number)
        for part in slices(len(rows), max(1, _TOGETHER // (k + 1))):
            block = rows[part]
            seen = _images_of_camera(views.take(block), theta[block], int(number), k)
            outline[block], outline_ok[block], glints[block], glint_ok[block] = seen
    return ModelFeatures(outline_px=outline, outline_ok=outline_ok, glints_px=glints, glint_ok=glint_ok)


def _images_of_camera(views: Views, theta: Floats, number: int, k: int) -> tuple[Floats, Bools, Floats, Bools]:
    """Trace outline and glints, and whether they exist, for the views of one camera."""
    camera = views.rig.cameras[number]
    eye = varied_eyes(take_eyes(views.eyes, views.person), theta)
    place = views.position_mm + theta[:, SLIPPAGE] + theta[:, POSITION]
    view = View.of(eye, Poses.listing(theta[:, AZIMUTH], theta[:, ELEVATION]), place, camera)

    def projected(exits: tuple[Floats, Floats, Floats], status: Statuses) -> tuple[Floats, Bools]:
        pixels, status = view.project(exits, status)
        return pixels, (status == Status.OK) & camera.in_image(pixels)

    exits, _, status = pupil_exits(eye, k, view.camera_mm)
    outline, outline_ok = projected(exits, status)
    if not len(views.rig.lights):
        return outline[:, :-1], outline_ok[:, :-1], np.empty((len(views), 0, 2)), np.empty((len(views), 0), dtype=bool)
    exits, _, status = glint_exits(eye, 1, view.into_eye(views.lights_mm), view.camera_mm)
    glints, glint_ok = projected(exits, status)
    lit = views.rig.lit((np.broadcast_to(eye.stop.handed, len(views)) < 0).astype(np.int64))
    return outline[:, :-1], outline_ok[:, :-1], glints, glint_ok & lit


def slopes_of(views: Views, theta: Floats, boundary_points: int, free: Bools | None = None) -> FeatureSlopes:
    """Trace features and their derivatives with respect to the unknowns, by central differences in one batch.

    Derivatives by unknowns that are not `free` (35,) may be 0.
    """
    moves = np.ones(COUNT, dtype=bool) if free is None else free.copy()
    moves[CENTRE] = moves[DEPTH] = True  # those of the outline
    moves[SLIPPAGE] |= moves[POSITION] | moves[ROTATION] | moves[GAP]
    use = moves[TRACED]
    traced_columns, steps = TRACED[use], STEPS[use]
    n, count = len(views), len(steps)
    shifts = np.zeros((1 + 2 * count, COUNT))
    shifts[1 : 1 + count, traced_columns] = np.diag(steps)
    shifts[1 + count :, traced_columns] = -np.diag(steps)
    stop = take_rows(views.eyes.stop, views.person)
    widening = _widening(stop, theta)
    every = np.tile(np.arange(n), len(shifts))
    all_theta = (theta[None] + shifts[:, None]).reshape(-1, COUNT)
    traced = images_of(views.take(every), all_theta, boundary_points)

    def slopes(points: Floats, ok: Bools, moves: Floats | None = None) -> tuple[Floats, Bools]:
        points = points.reshape(len(shifts), n, *points.shape[1:])
        step = steps[:, None, None, None]
        central = (points[1 : 1 + count] - points[1 + count :]) / (2.0 * step)
        out = np.zeros((*points.shape[1:], COUNT))
        out[..., traced_columns] = np.moveaxis(central, 0, -1)
        out[..., POSITION] = out[..., SLIPPAGE]
        # The motion of a turned eye per depth of its rotation centre is that of x' = M (x - c) + c, and M e_x is the
        # optic axis.
        by_azimuth = direction_of(theta[:, AZIMUTH], np.zeros(n)) - np.array([1.0, 0.0, 0.0])
        by_rotation = direction_of(theta[:, AZIMUTH], theta[:, ELEVATION]) - np.array([1.0, 0.0, 0.0])
        out[..., ROTATION] = np.einsum("nkax,nx->nka", out[..., SLIPPAGE], by_rotation)
        out[..., GAP] = np.einsum("nkax,nx->nka", out[..., SLIPPAGE], by_azimuth - by_rotation / 2.0)
        if moves is not None:
            out += out[..., [CENTRE.start, CENTRE.start + 1, DEPTH]] @ moves
            out[..., PUPIL] += np.einsum("nkxc,nc->nkx", out[..., CENTRE], theta[:, SHIFT])
        out[..., SHIFT] = out[..., CENTRE] * widening[:, None, None, None]
        exists: Bools = np.asarray(np.isfinite(out).all(axis=(2, 3)))
        return np.where(exists[..., None, None], out, 0.0), exists & ok[:n]

    outline, outline_ok = slopes(traced.outline_px, traced.outline_ok, _outline_moves(stop, theta, boundary_points))
    glints, glint_ok = slopes(traced.glints_px, traced.glint_ok)
    first = ModelFeatures(
        outline_px=traced.outline_px[:n],
        outline_ok=traced.outline_ok[:n],
        glints_px=traced.glints_px[:n],
        glint_ok=traced.glint_ok[:n],
    )
    return FeatureSlopes(images=first, outline=outline, glints=glints, outline_ok=outline_ok, glint_ok=glint_ok)


def lines_of_sight(views: Views, theta: Floats) -> tuple[Floats, Floats]:
    """Compute lines of sight in the world: points (n, 3) mm where they leave the cornea, and unit directions (n, 3)."""
    eyes, who = views.eyes, views.person
    handed, way = eyes.stop.handed[who], eyes.chief_ray.direction[who]
    nasal = np.arctan2(handed * way[:, 1], way[:, 0]) + theta[:, KAPPA][:, 0]
    up = np.arctan2(way[:, 2], way[:, 0]) + theta[:, KAPPA][:, 1]
    inside = normalize(np.stack([np.ones_like(up), handed * np.tan(nasal), np.tan(up)], axis=-1))
    turned = replace(eyes, rotation=_varied_centres(take_rows(eyes.rotation, who), theta))
    turn, shift = rigid_motion(Poses.listing(theta[:, AZIMUTH], theta[:, ELEVATION]), turned)
    place = views.position_mm + theta[:, SLIPPAGE] + theta[:, POSITION]
    point = np.einsum("nij,nj->ni", turn, eyes.chief_ray.point_mm[who]) + shift + place
    return point, np.asarray(np.einsum("nij,nj->ni", turn, inside))


def tangents(direction: Floats) -> Floats:
    """Return two unit vectors (n, 2, 3) across directions (n, 3): to the subject's left and up."""
    left = normalize(np.cross([0.0, 0.0, 1.0], direction))
    return np.stack([left, np.cross(direction, left)], axis=1)


def gaze_slopes(views: Views, theta: Floats) -> Floats:
    """Compute derivatives (n, 2, 35) of the line of sight's direction, left and up (rad), by the unknowns."""
    across = tangents(lines_of_sight(views, theta)[1])

    def shifts(rows: Ints, varied: Floats) -> Floats:
        return np.asarray(np.einsum("nci,ni->nc", across[rows], lines_of_sight(views.take(rows), varied)[1]))

    return _differences(theta, [AZIMUTH, ELEVATION, KAPPA.start, KAPPA.start + 1], shifts)


def target_misses(views: Views, theta: Floats, target_mm: Floats) -> Floats:
    """Compute angles (n, 2) in rad, left and up, from the direction of targets (n, 3) to the line of sight."""
    point, way = lines_of_sight(views, theta)
    return np.asarray(np.einsum("nci,ni->nc", tangents(normalize(target_mm - point)), way))


def target_slopes(views: Views, theta: Floats, target_mm: Floats) -> Floats:
    """Compute derivatives (n, 2, 35) of `target_misses` by the unknowns."""
    columns = [c for c in range(TORICITY.start) if c not in (PUPIL, RADIUS, ASPHERICITY, DEPTH)] + [GAP]
    return _differences(theta, columns, lambda rows, varied: target_misses(views.take(rows), varied, target_mm[rows]))


def _differences(theta: Floats, columns: Sequence[int], function: Callable[[Ints, Floats], Floats]) -> Floats:
    """Compute central differences (n, 2, 35) of a function of rows (m,) and their unknowns, with values (m, 2)."""
    n, count = len(theta), len(columns)
    steps = np.zeros((2, count, 1, COUNT))
    steps[0, np.arange(count), 0, columns] = _RAY_STEP
    steps[1] = -steps[0]
    varied = (theta + steps).reshape(-1, COUNT)
    after, before = function(np.tile(np.arange(n), 2 * count), varied).reshape(2, count, n, 2)
    out = np.zeros((n, 2, COUNT))
    out[..., columns] = np.moveaxis(after - before, 0, -1) / (2.0 * _RAY_STEP)
    return out
