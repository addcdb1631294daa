"""The renderer: jobs in, windows of the sensor out; NumPy on both sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayValue, Bools, Floats, frozen
from ..errors import InputError
from ..rig.imaging import AmbientSpec
from . import imaging, psf, sensor
from .environment import Ambience, Maps
from .film import Exposed, mean_radiance, pixels_of
from .frame import (
    RenderJob,
    ambient_numbers,
    camera_numbers,
    eye_numbers,
    kinds,
    light_table,
    look_numbers,
    margin_waves,
    panel_table,
    pose_numbers,
)
from .glints import POINT, GlintScene, GlintTable, Image, Spots, glint_table, quadrature
from .head import place_scene
from .integrator import integrator_class
from .lidshade import LidShade
from .lighting import through_cornea
from .occlusion import glint_reason, lid_margins_px
from .purkinje import purkinje_images
from .region import RegionScene, blockers, globe_of
from .sampling import camera_ray
from .surround import Obstacle, Surround
from .values import Lights, Structure, Values
from .view import Textures, look

if TYPE_CHECKING:
    from .backend import Backend

Glints = tuple[GlintTable, tuple[tuple[int, GlintTable], ...], tuple[str, ...]]
BACKGROUND, SCLERA, IRIS, PUPIL = 0, 1, 2, 3


@dataclass(frozen=True, slots=True, eq=False)
class PartLabels(ArrayValue):
    """What each pixel's centre shows, seen through the cornea; arrays (height, width).

    `part` and `amodal` hold 0 background or skin, 1 sclera, 2 iris, 3 pupil; `amodal` as if the eye stood alone.
    `depth_mm` is the distance from the nodal point to the first surface, infinite where there is none. The visible
    fractions are of the part of the amodal pupil and iris that lies in the window, NaN where none does.
    """

    part: NDArray[np.uint8]
    amodal: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]

    def visible_fraction(self, part: int) -> float:
        """Share of the amodal pixels of a part that are visible."""
        whole = int(np.count_nonzero(self.amodal == part))
        both = int(np.count_nonzero((self.amodal == part) & (self.part == part)))
        return both / whole if whole else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class RenderedWindow(ArrayValue):
    """A rendered window: `irradiance` (height, width) W/m^2 of the sensor, `dn` after the sensor, labels, glints.

    `purkinje` holds (order, table) of the mirror images beyond the first that were asked for. `failed_paths` counts
    light paths that did not converge (they are missing from the irradiance). `glint_reasons` says of each
    glint whether it is visible or what hides it; `lid_margins_px` holds landmarks along the lids where there are any.
    """

    window: tuple[int, int, int, int]
    irradiance: NDArray[np.float32]
    dn: NDArray[np.uint16]
    bit_depth: int
    labels: PartLabels | None
    glints: GlintTable
    purkinje: tuple[tuple[int, GlintTable], ...]
    failed_paths: int
    glint_reasons: tuple[str, ...] = ()
    lid_margins_px: dict[str, list[list[float]]] | None = None


class Renderer:
    """Renders jobs on one backend, which `choose_backend` must have set up before this module is imported.

    Kernels are compiled once per kind of eye; every number may change between jobs. `obstacles` stand in the scene's
    frame: they hide and shade the eye. `bounces` is how often light may go on between sclera, surround and the cornea's
    mirror (0: only light that comes straight from a lamp; more adds some noise and costs as much again each).
    """

    def __init__(
        self, backend: Backend, *, spp: int = 16, bounces: int = 0, obstacles: Sequence[Obstacle] = ()
    ) -> None:
        self.backend = backend
        self.spp = spp
        self._integrator = integrator_class()()
        self._integrator.bounces = bounces
        self._surround = Surround(obstacles)
        self._textures: dict[int, Textures] = {}
        self._regions: dict[Any, RegionScene] = {}
        self._maps = Maps()

    def render(self, job: RenderJob, *, spp: int | None = None, moments: Sequence[RenderJob] = ()) -> RenderedWindow:
        """Render one window.

        `moments` are the same window at moments of the exposure: their mean is the picture, with the samples shared
        among them; labels, glints and margins are those of `job`, the middle of the exposure.
        """
        shots = moments or (job,)
        pictures, failed = [], 0
        for shot in shots:
            picture, table, misses = self._picture(shot, max(1, (spp or self.spp) // len(shots)))
            pictures.append(picture)
            failed += misses
        blurred = np.mean(pictures, axis=0) * imaging.vignette(job.lens, job.camera, job.window)
        glints, others, reasons = self._add_glints(job, np.zeros_like(blurred)) if moments else table
        values = self._bind(job).values
        place = self._place(job)
        margins = lid_margins_px(place.posed, job.camera, job.anchor_mm) if isinstance(place, RegionScene) else None
        irradiance = frozen(blurred * sensor.radiance_to_irradiance(job.sensor), np.float32)
        # Of the irradiance as it is given away, so that exposing that again gives the same counts.
        dn = sensor.expose(job.sensor, irradiance.astype(float), job.wavelength_nm, job.seed)
        labels = self._labels(job, values) if job.labels else None
        return RenderedWindow(
            job.window,
            irradiance,
            frozen(dn, np.uint16),
            job.sensor.bit_depth,
            labels,
            glints,
            others,
            failed,
            reasons,
            margins,
        )

    def _picture(self, job: RenderJob, spp: int) -> tuple[Floats, Glints, int]:
        """Radiance of a window behind the lens, glints included; the glints; failed light paths."""
        shown = self._bind(job)
        depth = float(job.camera.R[2] @ (job.anchor_mm - job.camera.nodal_point_mm))
        kernel = imaging.disc(imaging.confusion_px(job.lens, job.camera, job.sensor, depth))
        x0, y0, width, height = job.window
        reach = kernel.shape[0] // 2
        sharp = replace(job, window=(x0 - reach, y0 - reach, width + 2 * reach, height + 2 * reach))
        pad = psf.margin(job.sensor.psf_sigma_px)
        x0, y0, width, height = sharp.window
        padded = (x0 - pad, y0 - pad, width + 2 * pad, height + 2 * pad)
        radiance, failed = mean_radiance(self._integrator, shown, padded, spp, job.seed, len(job.lights))
        blurred = psf.blur(radiance, job.sensor.psf_sigma_px).copy()
        glints = self._add_glints(sharp, blurred)
        return imaging.defocused(blurred, kernel), glints, failed

    def radiance(self, job: RenderJob, *, spp: int | None = None) -> Floats:
        """Mean radiance of each pixel times cos^4 of its field angle (mW/mm^2/sr), before lens and glints."""
        shown = self._bind(job)
        return mean_radiance(self._integrator, shown, job.window, spp or self.spp, job.seed, len(job.lights))[0]

    def iris_irradiance(self, job: RenderJob, points_mm: Floats) -> Floats:
        """Irradiance (n,) mW/mm^2 that points (n, 3) of the iris' plane (eye frame, mm) get from all lamps.

        A lamp of finite size is represented by its centre.
        """
        shown = self._bind(job)
        x = mi.Vector3f(*np.asarray(points_mm, dtype=np.float32).T)
        corner = mi.Float(0)  # of the unit square: the disc's centre
        inside = dr.full(mi.Bool, True, len(points_mm))
        bent, _ = through_cornea(shown.values, shown.lights, shown.scene, x, inside, corner, corner)
        return np.asarray(bent.numpy(), dtype=float)

    def labels(self, job: RenderJob) -> PartLabels:
        """The labels of a window alone."""
        return self._labels(job, self._bind(job).values)

    def _bind(self, job: RenderJob) -> Exposed:
        place = self._place(job)
        structure = Structure(
            kinds(job.eye),
            bool(np.any(job.camera.distortion)),
            place.obstructed,
            isinstance(place, RegionScene),
            job.ambient != AmbientSpec(),
        )
        anchor = job.anchor_mm
        numbers = {
            **eye_numbers(job.eye),
            **look_numbers(job.look),
            **pose_numbers(job.M, job.t, anchor),
            **camera_numbers(job.camera, anchor),
            **ambient_numbers(job.ambient),
            "region.mirror": place.mirror if isinstance(place, RegionScene) else 1.0,
            "region.sheet": int(place.posed.layout.face_ends[0]) if isinstance(place, RegionScene) else 0,
        }
        values = Values(structure, structure.pack(numbers), margin_waves(job.eye))
        lights = Lights(light_table(job.lights, job.M, job.t))
        textures = self._textures_of(job)
        if structure.ambient:
            even = job.ambient.irradiance_w_m2 * 1e-3
            lids = None
            if isinstance(place, RegionScene) and job.region is not None:
                lids = LidShade(place.posed, job.region.lids.margin_mm)
            ambience = Ambience(even, panel_table(job.ambient, anchor), job.ambient.map, self._maps, lids)
            textures = replace(textures, panels=ambience)
        if isinstance(place, RegionScene):
            textures = replace(textures, region=place.map)
        else:
            place.show(job.look)
        self._integrator.bind(values, lights, textures)
        return Exposed(place.scene, values, lights, textures)

    def _place(self, job: RenderJob) -> Surround | RegionScene:
        """What stands around the job's eye: its region at the job's pose, or the surround."""
        if job.region is None:
            return self._surround
        if self._surround.obstructed:
            raise InputError("obstacles and an eye region do not go together")
        globe = globe_of(job.eye, job.M, job.t - job.anchor_mm)
        key = RegionScene.key(job.region, globe)
        if key not in self._regions:
            if len(self._regions) >= 4:
                self._regions.pop(next(iter(self._regions)))
            self._regions[key] = place_scene(job.region, globe)
        place = self._regions[key]
        place.show(job.region, globe)
        return place

    def _textures_of(self, job: RenderJob) -> Textures:
        seed = job.look.iris_seed
        if seed not in self._textures:
            if len(self._textures) >= 8:
                self._textures.pop(next(iter(self._textures)))
            self._textures[seed] = Textures.of_seed(seed)
        return self._textures[seed]

    def _labels(self, job: RenderJob, values: Values) -> PartLabels:
        width, height = job.window[2:]
        u, v = pixels_of(dr.arange(mi.UInt32, width * height), job.window)
        o, d, _ = camera_ray(values, mi.Float(u), mi.Float(v))
        view = look(values, self._place(job).scene, o, d, True)
        clear = view.amodal_cornea & (view.opacity < 0.5)
        amodal = dr.select(
            view.amodal_cornea | view.amodal_sclera,
            dr.select(clear, dr.select(view.pupil, mi.UInt32(PUPIL), mi.UInt32(IRIS)), mi.UInt32(SCLERA)),
            mi.UInt32(BACKGROUND),
        )
        eye = view.cornea | view.sclera
        part = dr.select(eye, amodal, mi.UInt32(BACKGROUND))
        depth = dr.select(eye | view.other, view.distance, dr.inf)
        dr.eval(amodal, part, depth)
        shape = (height, width)
        return PartLabels(
            frozen(part.numpy().reshape(shape), np.uint8),
            frozen(amodal.numpy().reshape(shape), np.uint8),
            frozen(depth.numpy().reshape(shape), np.float32),
        )

    def _add_glints(self, job: RenderJob, image: Floats) -> Glints:
        """Add the lamps' mirror images to the blurred picture: the glints' table, those of further orders, and why each
        glint is seen or not."""
        eye, anchor, sigma = job.eye, job.anchor_mm, job.sensor.psf_sigma_px

        def clear(a: Floats, b: Floats) -> Bools:
            return self._place(job).clear(a - anchor, b - anchor)

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
                # These images are small: their mirrors are strongly curved, or concave with a short focus.
                nodes = [quadrature(3, 14) if lamp.radius_mm > 0 else POINT for lamp in job.lights]
                images = purkinje_images(scene, eye, order, job.lights, nodes)
            tables[order], spots = glint_table(scene, images)
            if order == 1:
                reasons = tuple(self._reason(job, image) for image in images)
            if order in job.purkinje:
                self._splat(job, image, spots)
        return tables[1], tuple((order, table) for order, table in tables.items() if order > 1), reasons

    def _reason(self, job: RenderJob, image: Image) -> str:
        """Why a lamp's glint is seen or not."""
        place, anchor = self._place(job), job.anchor_mm
        node = np.broadcast_to(job.camera.nodal_point_mm, image.exit_mm.shape)
        ways = [(image.source_mm - anchor, image.entry_mm - anchor), (node - anchor, image.exit_mm - anchor)]
        open_ = np.ones(len(node), dtype=bool)
        if place.obstructed:
            open_ = place.clear(*ways[0]) & place.clear(*ways[1])
        names: list[str | None] = [None] * len(open_)
        if isinstance(place, RegionScene) and not np.all(open_):
            to_lamp, to_camera = (blockers(place, *way) for way in ways)
            names = [c if c is not None else a for a, c in zip(to_lamp, to_camera, strict=True)]
        return glint_reason(image.energy, open_, names)

    @staticmethod
    def _splat(job: RenderJob, image: Floats, images: Sequence[Spots]) -> None:
        for spots in images:
            if len(spots.energy):
                cosine = job.camera.rays(spots.xy_px) @ job.camera.axis
                patch, rows, columns = psf.splat(
                    spots.xy_px, spots.energy * cosine**4, job.sensor.psf_sigma_px, job.window
                )
                image[rows, columns] += patch
