"""Splatting of the lamps' visible mirror images into an image, with the reasons for those that are hidden."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats
from ..rig import psf
from .frame import RenderJob
from .glints import POINT, GlintScene, GlintTable, Image, Spots, glint_table, quadrature
from .occlusion import glint_reason
from .purkinje import purkinje_images
from .region import RegionScene, blockers
from .surround import Surround


@dataclass(frozen=True, slots=True)
class Mirrored:
    """The glints, (order, table) of the requested further images, and why each glint is visible or not."""

    glints: GlintTable
    others: tuple[tuple[int, GlintTable], ...]
    reasons: tuple[str, ...]


def add_glints(job: RenderJob, place: Surround | RegionScene, image: Floats) -> Mirrored:
    """Add the mirror images of a job's lamps to its blurred image (height, width)."""
    eye, anchor, sigma = job.eye, job.anchor_mm, job.sensor.psf_sigma_px

    def clear(a: Floats, b: Floats) -> Bools:
        return place.clear(a - anchor, b - anchor)

    scene = GlintScene(
        eye.front[0], float(eye.front_indices[0]), float(eye.limbus_radius_mm), np.asarray(eye.sclera.centre_mm),
        float(eye.sclera.radius_mm), job.M, job.t, job.camera, clear,
    )  # fmt: skip
    tables = {}
    reasons: tuple[str, ...] = ()
    for order in sorted({1, *job.purkinje}):
        if order == 1:
            images = scene.images(job.lights, sigma)
        else:
            # These images are small, because their mirrors are strongly curved, or concave with a short focus.
            nodes = [quadrature(3, 14) if lamp.radius_mm > 0 else POINT for lamp in job.lights]
            images = purkinje_images(scene, eye, order, job.lights, nodes)
        tables[order], spots, ways = glint_table(scene, images)
        if order == 1:
            pairs = zip(images, ways, strict=True)
            reasons = tuple(_reason(job, place, image, open_) for image, open_ in pairs)
        if order in job.purkinje:
            _splat(job, image, spots)
    return Mirrored(tables[1], tuple((order, table) for order, table in tables.items() if order > 1), reasons)


def _reason(job: RenderJob, place: Surround | RegionScene, image: Image, open_: Bools) -> str:
    """State whether or why not a lamp's glint is visible; `open_` (k,) marks the points that nothing blocks."""
    if not place.obstructed:
        open_ = np.ones(len(open_), dtype=bool)
    names: list[str | None] = [None] * len(open_)
    if isinstance(place, RegionScene) and not np.all(open_):
        anchor = job.anchor_mm
        node = np.broadcast_to(job.camera.nodal_point_mm, image.exit_mm.shape)
        to_lamp = blockers(place, image.source_mm - anchor, image.entry_mm - anchor)
        to_camera = blockers(place, node - anchor, image.exit_mm - anchor)
        names = [c if c is not None else a for a, c in zip(to_lamp, to_camera, strict=True)]
    return glint_reason(image.energy, open_, names)


def _splat(job: RenderJob, image: Floats, images: Sequence[Spots]) -> None:
    for spots in images:
        if len(spots.energy):
            cosine = job.camera.rays(spots.xy_px) @ job.camera.axis
            patch, rows, columns = psf.splat(spots.xy_px, spots.energy * cosine**4, job.sensor.psf_sigma_px, job.window)
            image[rows, columns] += patch
