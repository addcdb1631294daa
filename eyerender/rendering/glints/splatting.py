"""Mirror images of the lamps in an image: their visible parts, the reasons, and how they are splatted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...base.arrays import OBSTACLE, SPECTACLE_FRAME, Bools, Cache, Floats, Singles, frozen
from ...rig import defocus, psf
from ...rig.camera import Window
from ...rig.light import Lamp
from ..hits.meshes import SurfaceMesh
from ..records.job import RenderJob, sun_lamps
from ..scene.background import Background, blockers
from ..scene.blur import Blur
from ..scene.region import RegionScene
from .cutdiscs import POINT, quadrature
from .lensglints import defocused, lens_reflections
from .purkinje import purkinje_images
from .tracing import Glint, GlintScene, GlintTable, Image, LampImages, LampSpots, glint_table

_KNOWN: Cache[list[Image]] = Cache(8)
_FRAMED = "occluded by frame"
_BY = {"skin": "lid", "tears": "lid", "lashes": "lash", "brow": "brow"}
_BY |= {SPECTACLE_FRAME: SPECTACLE_FRAME, OBSTACLE: OBSTACLE}


@dataclass(frozen=True, slots=True)
class Shine:
    """Contribution of a mirror image, in the cornea or in a worn lens: spots, share of the exposure, blur disc (px)."""

    spots: LampSpots
    share: float
    blur_px: float
    of_lens: bool = False


def add_shines(shines: Sequence[Shine], picture: Singles, job: RenderJob) -> None:
    """Add mirror images, blurred by lens and pixels, to the image (height, width) of a job's window."""
    lit = [shine for shine in shines if len(shine.spots.energy)]
    if not lit:
        return
    camera, counts = job.camera, [len(shine.spots.energy) for shine in lit]
    falloff = camera.glint_falloff(np.concatenate([shine.spots.xy_px for shine in lit]))
    for shine, part in zip(lit, np.split(falloff, np.cumsum(counts)[:-1]), strict=True):
        energy, spread = shine.share * shine.spots.energy * part, defocus.disc(shine.blur_px)
        patch, rows, columns = psf.splat(shine.spots.xy_px, energy, job.sensor.psf_sigma_px, job.window, spread)
        picture[rows, columns] += patch


@dataclass(frozen=True, slots=True)
class Mirrored:
    """Tables of the glints and of the requested mirror images (order, table), and why each glint is visible or not."""

    glints: GlintTable
    others: tuple[tuple[int, GlintTable], ...]
    reasons: tuple[str, ...]

    def behind(self, covered: Bools, window: Window) -> Mirrored:
        """Hide mirror images where a frame around the view covers pixels (height, width) of a window."""
        table, (x0, y0, width, height) = self.glints, window
        xy = np.nan_to_num(table.xy_px, nan=-1e6)
        column, row = (np.rint(xy - (x0, y0)).astype(int)).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        hidden = inside & table.visible & covered[np.where(inside, row, 0), np.where(inside, column, 0)]
        glints = replace(
            table, share=frozen(np.where(hidden, 0.0, table.share)), visible=frozen(table.visible & ~hidden, np.bool_)
        )
        reasons = tuple(_FRAMED if h else reason for h, reason in zip(hidden, self.reasons, strict=True))
        return Mirrored(glints, self.others, reasons)


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorImages:
    """Mirror images of a job's lamps and of the sun, before occlusion."""

    job: RenderJob
    lamps: tuple[Lamp, ...]  # its lamps, and the sun if there is one
    scene: GlintScene  # the mirrors
    first: LampImages  # images in the front of the cornea
    further: dict[int, list[Image]]  # requested images of higher orders
    nearness: Floats  # (n, 2) inverse depths (1/mm) of the first images; NaN where not needed
    in_lenses: list[Image]  # images in worn lenses
    ghosts: list[Image]  # ghosts of the first images, by the back of a mirror's glass; empty without

    @classmethod
    def of(cls, job: RenderJob, mesh: SurfaceMesh | None, before: MirrorImages | None = None) -> MirrorImages:
        """Compute the images, on the host unless a mesh replaces the cornea's front.

        `before` are those of a moment ago, whose quadratures are taken over.
        """
        eye = job.eye
        scene = GlintScene.of(eye, job.film_index, job.M, job.t, job.camera, mesh, job.turned_lenses)
        lamps = (*job.lights, *sun_lamps(job.ambient, job.anchor_mm))
        # These images are small, because their mirrors are strongly curved, or concave with a short focus.
        nodes = [quadrature(3, 14) if lamp.radius_mm > 0 else POINT for lamp in lamps]
        further = {order: purkinje_images(scene, eye, order, lamps, nodes) for order in sorted({*job.purkinje} - {1})}
        near = 1 in job.purkinje and job.lens.focus_mm is not None
        nearness = scene.nearness(lamps) if near else np.full((len(lamps), 2), np.nan)
        first = scene.images(lamps, job.sensor.psf_sigma_px, None if before is None else before.first.counts)
        # Lenses do not turn with the eye, so frames that differ in gaze only share their reflections.
        key = eye.worn, lamps, job.camera, job.anchor_mm.tobytes()
        mirrored = _KNOWN.get(key, lambda: lens_reflections(scene, eye.worn, lamps, job.anchor_mm)) if eye.worn else []
        return cls(
            job=job, lamps=lamps, scene=scene, first=first, further=further, nearness=nearness, in_lenses=mirrored,
            ghosts=scene.ghosts(lamps, first.parts, job.sensor.psf_sigma_px) if 1 in job.purkinje else [],
        )  # fmt: skip

    def seen(self, place: Background | RegionScene, blur: Blur, share: float = 1.0) -> tuple[Mirrored, list[Shine]]:
        """Return the visible parts of the images in posed surroundings, and their contribution to the blurred image.

        Tables and reasons are for lamps only, without the sun. `share` is the job's share of the exposure.
        """
        job, anchor, count = self.job, self.job.anchor_mm, len(self.job.lights)

        def clear(a: Floats, b: Floats) -> Bools:
            return place.clear(a - anchor, b - anchor)

        glints = self.scene.glints(self.lamps, self.first, clear)
        reasons = tuple(_reason(job, place, glint) for glint in glints[:count])
        further = {order: self.scene.seen(images, clear) for order, images in self.further.items()}
        shines = []
        for order in sorted({*job.purkinje}):
            # The images of higher orders are about as far away as the iris.
            sizes = [blur.of_image(near) for near in self.nearness] if order == 1 else [blur.subject_px] * len(glints)
            shines += [
                Shine(glint.spots, share, size) for glint, size in zip(further.get(order, glints), sizes, strict=True)
            ]
        ghosts = self.scene.seen(self.ghosts, clear) if self.ghosts else []
        shines += [
            Shine(ghost.spots, share, blur.of_image(near)) for ghost, near in zip(ghosts, self.nearness, strict=False)
        ]
        in_lenses = self.scene.seen(self.in_lenses, clear) if self.in_lenses else []
        shines += [Shine(defocused(glint.spots, blur.subject_px), share, 0.0, True) for glint in in_lenses]
        others = tuple((order, glint_table(found[:count])) for order, found in further.items())
        return Mirrored(glint_table(glints[:count]), others, reasons), shines


def _reason(job: RenderJob, place: Background | RegionScene, glint: Glint) -> str:
    """Describe whether, or why not, a lamp's glint is visible."""
    image = glint.image
    open_ = glint.clear if place.obstructed else np.ones(len(glint.clear), dtype=bool)
    names: list[str | None] = [None] * len(open_)
    if not np.all(open_):
        anchor = job.anchor_mm
        node = np.broadcast_to(job.camera.nodal_point_mm, image.exit_mm.shape)
        to_lamp = blockers(place, image.source_mm - anchor, image.entry_mm - anchor)
        to_camera = blockers(place, node - anchor, image.exit_mm - anchor)
        names = [c if c is not None else a for a, c in zip(to_lamp, to_camera, strict=True)]
    return glint_reason(image.there, open_, names)


def glint_reason(there: Bools, open_: Bools, blockers: Sequence[str | None]) -> str:
    """Describe a lamp's mirror image: visible, partly or fully occluded (and mostly by what), or off the cornea.

    `there`: (k,) whether the cornea mirrors the points of the lamp to the camera; `open_`: (k,) whether nothing of the
    scene blocks the point; `blockers`: (k,) name of the blocking part, None if there is none.
    """
    if not np.any(there):
        return "off the cornea"
    if np.all(open_[there]):
        return "visible" if np.all(there) else "partly off the cornea"
    names = [
        _BY.get(b, "head") for b, t, o in zip(blockers, there, open_, strict=True) if t and not o and b is not None
    ]
    by = max(sorted(set(names)), key=names.count) if names else "head"
    return f"occluded by {by}" if not np.any(open_[there]) else f"partly occluded by {by}"
