"""A traced frame, and the sensor window that lens and sensor make of it on the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import ArrayValue, Bools, Floats, Singles, frozen, sealed
from ...base.errors import InputError
from ...rig import defocus, exposure, psf, stray
from ...rig.camera import PinholeCamera, Window
from ...rig.imaging import Lens
from ..glints.splatting import Mirrored, Shine, add_shines
from ..glints.tracing import GlintTable, LampSpots
from ..records.job import RenderJob
from ..scene.blur import Blur
from .geometry import Geometry, Hits, geometry_of
from .labels import PartLabels


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RenderedWindow(ArrayValue):
    """A rendered window."""

    window: Window  # (x0, y0, width, height) in full-sensor pixels
    irradiance: Singles  # (height, width) W/m^2 of the sensor
    dn: NDArray[np.uint16]  # (height, width) digital numbers of the sensor
    bit_depth: int  # bits of `dn`
    labels: PartLabels | None  # raster labels, if they or geometry were requested
    glints: GlintTable  # the glints, the mirror images of order 1
    purkinje: tuple[tuple[int, GlintTable], ...]  # (order, table) of the other mirror images that were requested
    failed_paths: int  # number of light paths that did not converge; they are missing from the irradiance
    glint_reasons: tuple[str, ...] = ()  # for each glint, whether it is visible or what hides it
    lid_margins_px: dict[str, list[list[float]]] | None = None  # landmarks along the lids, where there are any
    # (height, width) pixels with highlights of wet and oily surfaces, if they were requested
    highlights: Bools | None = None
    geometry: Geometry | None = None  # depth, normals, coordinates on the iris and instances, if they were requested
    # (height, width) pixels where worn lenses mirror more light than comes from behind them, before glare and sensor;
    # None without lenses
    lens_reflections: Bools | None = None

    def flipped(self, camera: PinholeCamera) -> RenderedWindow:
        """Return the window turned left to right, with normals in its own frame; `camera` is that before the flip."""
        last = camera.resolution_px[0] - 1

        def turned(value: Any) -> Any:
            """Turn pictures, records of pictures, and tables of glints."""
            if isinstance(value, GlintTable):
                return replace(value, xy_px=frozen(np.array([last, 0]) + value.xy_px * (-1, 1)))
            if isinstance(value, PartLabels | Geometry):
                return replace(value, **{f.name: turned(getattr(value, f.name)) for f in fields(value)})
            if value is None:
                return None
            sign = (-1, 1, 1) if value.shape[2:] == (3,) else 1  # of normals
            return frozen(value[:, ::-1] * np.array(sign, value.dtype), value.dtype)

        names = ("irradiance", "dn", "labels", "glints", "highlights", "geometry", "lens_reflections")
        lids = {lid: [[last - x, y] for x, y in points] for lid, points in (self.lid_margins_px or {}).items()}
        others = tuple((order, turned(table)) for order, table in self.purkinje)
        changed: dict[str, Any] = {name: turned(getattr(self, name)) for name in names}
        window = camera.turned(self.window)
        return replace(self, window=window, purkinje=others, lid_margins_px=lids or None, **changed)


@dataclass(frozen=True, slots=True, eq=False)
class Exposed(ArrayValue):
    """Light of one exposure."""

    picture: Singles  # mean radiance of the pixels, with the border that the lens needs, or its parts
    glints: tuple[Shine, ...]  # light of the lamps' mirror images
    rows: Floats | None = None  # (height,) share of the exposure of each row; None: all of it
    # (height, width) what worn lenses mirror of the ambient light, with the same border; None for nothing
    in_lenses: Singles | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RawFrame(ArrayValue):
    """A traced frame before lens and sensor are applied."""

    job: RenderJob  # the frame's job
    exposed: tuple[Exposed, ...]  # the light of the frame, in parts of the exposure if its rows differ
    blur: Blur  # defocus of the job
    mirrored: Mirrored  # positions and energies of the glints
    labels: PartLabels | None  # raster labels, if they or geometry were requested
    failed: int  # number of light paths that did not converge
    lid_margins_px: dict[str, list[list[float]]] | None  # landmarks along the lids, where there are any
    highlights: Bools | None  # (height, width) highlights of wet and oily surfaces, if they were requested
    hits: Hits | None = None  # hits of the rays through the centres of pixels, if geometry was requested
    # mean radiance of the whole sensor in blocks (`coarse_sensor`), where light from there strays into the window; else
    # None
    around: Singles | None = None

    def develop(self) -> RenderedWindow:
        """Apply lens and sensor. This never touches the device, so another thread may do it.

        Raises:
            InputError: numbers so extreme that the image is not finite.
        """
        job, labels, mirrored, highlights = self.job, self.labels, self.mirrored, self.highlights
        irradiance, reflections = self._of_rows()
        irradiance = sealed(irradiance)
        if not np.all(np.isfinite(irradiance)):
            raise InputError("the numbers of the scene are too extreme: its image is not finite")
        # The counts are computed from the returned irradiance, so that exposing it again gives the same counts.
        dn = exposure.recorded(job.sensor, job.camera, job.window, irradiance, job.wavelength_nm, job.seed)
        geometry = None if self.hits is None else geometry_of(job, self.hits)
        covered = stray.covered(job.lens, job.sensor, job.camera, job.window)
        if covered is not None:
            labels = labels.behind(covered) if labels is not None else None
            mirrored = mirrored.behind(covered, job.window)
            highlights = None if highlights is None else frozen(highlights & ~covered, np.bool_)
            geometry = None if geometry is None else geometry.behind(covered)
            reflections &= ~covered
        done = RenderedWindow(
            window=job.window,
            irradiance=irradiance,
            dn=sealed(dn),
            bit_depth=job.sensor.bit_depth,
            labels=labels,
            glints=mirrored.glints,
            purkinje=mirrored.others,
            failed_paths=self.failed,
            glint_reasons=mirrored.reasons,
            lid_margins_px=self.lid_margins_px,
            highlights=highlights,
            geometry=geometry,
            lens_reflections=frozen(reflections, np.bool_) if job.eye.worn else None,
        )
        return done.flipped(job.camera) if job.flip else done

    def _of_rows(self) -> tuple[Singles, Bools]:
        """Add up the parts of the exposure: irradiance (height, width) W/m^2, and lens reflections.

        Reflections are those of the part that a row gets most of.
        """
        if len(self.exposed) == 1 and self.exposed[0].rows is None:
            return self._irradiance(self.exposed[0])
        height = self.job.window[3]
        shares = np.stack([np.ones(height) if e.rows is None else e.rows for e in self.exposed]).astype(np.float32)
        total = np.zeros((height, self.job.window[2]), np.float32)
        reflections = np.zeros(total.shape, np.bool_)
        for k, exposed in enumerate(self.exposed):
            if shares[k].any():
                light, mirrored = self._irradiance(exposed)
                total += shares[k][:, None] * light
                most = shares.argmax(axis=0) == k
                reflections[most] = mirrored[most]
        return total, reflections

    def _irradiance(self, exposed: Exposed) -> tuple[Singles, Bools]:
        """Compute the irradiance (height, width) of the window, W/m^2, in one exposure, and its lens reflections."""
        job = self.job
        # Single precision is finer than the samples' noise, and takes half the time.
        picture = psf.blur(self.blur.of_pictures(exposed.picture).astype(np.float32), job.sensor.psf_sigma_px)
        add_shines([shine for shine in exposed.glints if not shine.of_lens], picture, job)
        mirrored = np.zeros_like(picture)
        if exposed.in_lenses is not None:
            blurred = self.blur.of_reflections(exposed.in_lenses).astype(np.float32)
            mirrored = psf.blur(blurred, job.sensor.psf_sigma_px)
        add_shines([shine for shine in exposed.glints if shine.of_lens], mirrored, job)
        reflections = mirrored > picture
        picture += mirrored
        picture = stray.starred(picture, job.lens.star)
        seen = (job.lens, job.camera, job.window)
        picture = _framed(picture, *seen)
        if self.around is None:
            picture = stray.scattered(picture, *seen)
        else:
            picture = stray.scattered_around(picture, self._around(self.around, exposed.glints), *seen)
        beyond = job.camera.dark(job.window)
        if beyond is not None:
            picture = np.where(beyond, np.float32(0), picture)
        return np.asarray(picture * np.float32(exposure.radiance_to_irradiance(job.sensor))), reflections

    def _around(self, cells: Singles, glints: Sequence[Shine]) -> Singles:
        """Return the whole sensor in blocks, seen through the openings, with the mirror images of the lamps."""
        job, side = self.job, stray.block_px(self.job.lens)
        lens, camera = stray.in_blocks(job.lens, job.camera, side)
        whole, picture = (0, 0, *camera.resolution_px), cells.copy()
        sensor = job.sensor.model_copy(update={"psf_sigma_px": job.sensor.psf_sigma_px / side})
        shines = [
            replace(
                shine,
                spots=LampSpots(frozen((shine.spots.xy_px + 0.5) / side - 0.5), frozen(shine.spots.energy / side**2)),
                blur_px=shine.blur_px / side,
            )
            for shine in glints
        ]
        add_shines(shines, picture, replace(job, camera=camera, window=whole, sensor=sensor))
        return _framed(picture, lens, camera, whole)


def _framed(picture: Singles, lens: Lens, camera: PinholeCamera, window: Window) -> Singles:
    """Compute the image (height, width) of a window behind fall-off, vignetting and openings; the input may change."""
    if camera.mirror is not None:
        picture *= np.float32(camera.mirror.reflectance)
    if camera.relative_illumination is not None:
        picture *= camera.illumination(window).astype(np.float32)
    if lens.vignetting > 0:
        picture *= defocus.vignette(lens, camera, window)
    return np.asarray(stray.framed(picture, lens, camera, window))
