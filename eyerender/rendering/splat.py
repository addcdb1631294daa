"""Splatting of the lamps' visible mirror images into an image, with the reasons for those that are hidden."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import ArrayValue, Bools, Floats, frozen
from ..rig import defocus, psf
from ..rig.camera import Window
from .blur import Blur
from .cut import POINT, quadrature
from .frame import RenderJob, sun_lamps
from .glints import Glint, GlintScene, GlintTable, Spots, glint_table
from .meshed import SurfaceMesh
from .occlusion import glint_reason
from .purkinje import purkinje_images
from .region import RegionScene, blockers
from .surround import Surround

_FRAMED = "occluded by frame"


@dataclass(frozen=True, slots=True, eq=False)
class Patch(ArrayValue):
    """Blurred radiance (rows, columns) of a mirror image on the part of a window that it reaches."""

    rows: slice
    columns: slice
    radiance: Floats


@dataclass(frozen=True, slots=True)
class Mirrored:
    """The glints, (order, table) of the requested further images, and why each glint is visible or not."""

    glints: GlintTable
    others: tuple[tuple[int, GlintTable], ...]
    reasons: tuple[str, ...]

    def behind(self, covered: Bools, window: Window) -> Mirrored:
        """The same where what frames the camera's view covers pixels (height, width) of a window."""
        table, (x0, y0, width, height) = self.glints, window
        xy = np.nan_to_num(table.xy_px, nan=-1e6)
        column, row = (np.rint(xy - (x0, y0)).astype(int)).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        hidden = inside & table.visible & covered[np.where(inside, row, 0), np.where(inside, column, 0)]
        glints = replace(
            table,
            share=frozen(np.where(hidden, 0.0, table.share)),
            visible=frozen(table.visible & ~hidden, np.bool_),
        )
        reasons = tuple(_FRAMED if h else reason for h, reason in zip(hidden, self.reasons, strict=True))
        return Mirrored(glints, self.others, reasons)


def mirror_images(
    job: RenderJob, place: Surround | RegionScene, blur: Blur, mesh: SurfaceMesh | None, share: float = 1.0
) -> tuple[Mirrored, list[Patch]]:
    """The mirror images of a job's lamps and of the sun, and what they add to its blurred image.

    The tables and reasons are those of the lamps alone. `share` is that of the exposure for which the job stands.
    """
    eye, anchor, sigma = job.eye, job.anchor_mm, job.sensor.psf_sigma_px

    def clear(a: Floats, b: Floats) -> Bools:
        return place.clear(a - anchor, b - anchor)

    scene = GlintScene(
        eye.front[0], float(eye.front_indices[0]), job.film_index, float(eye.limbus_radius_mm),
        np.asarray(eye.sclera.centre_mm), float(eye.sclera.radius_mm), job.M, job.t, job.camera, clear, mesh,
    )  # fmt: skip
    count, lamps = len(job.lights), (*job.lights, *sun_lamps(job.ambient, anchor))
    tables, patches = {}, []
    reasons: tuple[str, ...] = ()
    for order in sorted({1, *job.purkinje}):
        if order == 1:
            glints = scene.glints(lamps, sigma)
            reasons = tuple(_reason(job, place, glint) for glint in glints[:count])
        else:
            # These images are small, because their mirrors are strongly curved, or concave with a short focus.
            nodes = [quadrature(3, 14) if lamp.radius_mm > 0 else POINT for lamp in lamps]
            glints = scene.seen(purkinje_images(scene, eye, order, lamps, nodes))
        tables[order] = glint_table(glints[:count])
        if order in job.purkinje:
            # The further images are about as far as the iris.
            own = order == 1 and job.lens.focus_mm is not None
            nearness = scene.nearness(lamps) if own else np.full((len(glints), 2), np.nan)
            for glint, near in zip(glints, nearness, strict=True):
                patches += _drawn(job, glint.spots, share, defocus.disc(blur.of_image(near)))
    others = tuple((order, table) for order, table in tables.items() if order > 1)
    return Mirrored(tables[1], others, reasons), patches


def _reason(job: RenderJob, place: Surround | RegionScene, glint: Glint) -> str:
    """State whether or why not a lamp's glint is visible."""
    image = glint.image
    open_ = glint.clear if place.obstructed else np.ones(len(glint.clear), dtype=bool)
    names: list[str | None] = [None] * len(open_)
    if isinstance(place, RegionScene) and not np.all(open_):
        anchor = job.anchor_mm
        node = np.broadcast_to(job.camera.nodal_point_mm, image.exit_mm.shape)
        to_lamp = blockers(place, image.source_mm - anchor, image.entry_mm - anchor)
        to_camera = blockers(place, node - anchor, image.exit_mm - anchor)
        names = [c if c is not None else a for a, c in zip(to_lamp, to_camera, strict=True)]
    return glint_reason(image.there, open_, names)


def _drawn(job: RenderJob, spots: Spots, share: float, spread: Floats) -> list[Patch]:
    """A share of the spots of a glint, blurred by the lens and convolved with `spread`."""
    if not len(spots.energy):
        return []
    energy = share * spots.energy * (job.camera.rays(spots.xy_px) @ job.camera.axis) ** 4
    patch, rows, columns = psf.splat(spots.xy_px, energy, job.sensor.psf_sigma_px, job.window, spread)
    return [Patch(rows, columns, patch)]
