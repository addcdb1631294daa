"""The renderer turns jobs into windows of the sensor, with NumPy on both sides."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import Floats, Singles
from ..imagefolder import BACKGROUND, FRAME, IRIS, PUPIL, SCLERA
from ..rig import psf
from .blur import Blur
from .film import Exposed, mean_parts, mean_radiance
from .frame import RenderJob
from .labels import PartLabels, depths_mm, highlights, part_labels
from .lighting import through_cornea
from .occlusion import lid_margins_px
from .recorded import uncollected
from .region import RegionScene
from .splat import Patch, mirror_images
from .stage import Stage
from .surround import Obstacle, Surround
from .window import RenderedWindow, Traced

if TYPE_CHECKING:
    from ..backends.choose import Backend

__all__ = ["BACKGROUND", "FRAME", "IRIS", "PUPIL", "SCLERA", "PartLabels", "RenderJob", "RenderedWindow", "Renderer"]


class Renderer:
    """Renders jobs on one backend, which `choose_backend` must have set up before this module is imported.

    Kernels are compiled once per kind of eye; every number may change between jobs.

    Args:
        backend: the backend.
        spp: samples per pixel.
        obstacles: bodies in the scene's frame that hide and shade the eye.
    """

    def __init__(self, backend: Backend, *, spp: int = 16, obstacles: Sequence[Obstacle] = ()) -> None:
        self.backend = backend
        self.spp = spp
        self._stage = Stage(obstacles)
        self._beside = ThreadPoolExecutor(1, "develop")

    def render(self, job: RenderJob, *, spp: int | None = None, moments: Sequence[RenderJob] = ()) -> RenderedWindow:
        """Render one window.

        Args:
            job: what to render.
            spp: samples per pixel; None: those of the renderer.
            moments: the same window at moments of the exposure. Their mean is the image, with the samples shared among
                them; labels, glints and margins are those of `job`, the middle of the exposure.

        Raises:
            InputError: numbers so extreme that the image is not finite.
        """
        return self._traced(job, spp, moments, None).developed()

    def begin(
        self,
        job: RenderJob,
        *,
        spp: int | None = None,
        moments: Sequence[RenderJob] = (),
        after: RenderJob | None = None,
    ) -> Future[RenderedWindow]:
        """Trace one window now, and develop it in a second thread, beside the tracing of the next.

        The arguments are those of `render`. `after` is the job that comes next, if it is known: the mesh of its region
        is made in the second thread, too. The results do not depend on it.
        """
        return self._beside.submit(self._traced(job, spp, moments, after).developed)

    @uncollected
    def _traced(self, job: RenderJob, spp: int | None, moments: Sequence[RenderJob], after: RenderJob | None) -> Traced:
        shots = moments or (job,)
        spp = max(1, (spp or self.spp) // len(shots))
        blur: Blur | None = None
        front = None if job.mesh_edge_mm is None else self._stage.meshes.of(job.eye, job.mesh_edge_mm)[0]
        pictures, failed = [], 0
        glints: list[Patch] = []
        marks: tuple[Any, ...] | None = None
        for shot in shots:
            shown, place = self.bind(shot)
            if after is not None and shot is shots[-1] and not moments:
                self._stage.expect(after, self._beside)
            blur = blur or Blur.of(job, place)
            picture, missed = self._pictures(shot, shown, blur, spp)
            pictures.append(picture)
            mirrored, patches = mirror_images(shot, place, blur, front, 1 / len(shots))
            glints += patches
            failed += missed
            if shot.M is job.M and shot.t is job.t:
                marks = mirrored, *_marks(job, shown, place)
        assert blur is not None
        if marks is None:  # no moment is the middle of the exposure
            shown, place = self.bind(job, lit=False)
            marks = mirror_images(job, place, blur, front)[0], *_marks(job, shown, place)
        mirrored, labels, margins, bright = marks
        radiance = pictures[0] if len(pictures) == 1 else np.mean(pictures, axis=0)
        return Traced(job, radiance, tuple(glints), blur, mirrored, labels, failed, margins, bright)

    def _pictures(self, job: RenderJob, shown: Exposed, blur: Blur, spp: int) -> tuple[Singles, int]:
        """Radiance of a window, or its parts, with the border that the lens needs, and failed light paths."""
        pad = blur.reach + psf.margin(job.sensor.psf_sigma_px)
        x0, y0, width, height = job.window
        padded = (x0 - pad, y0 - pad, width + 2 * pad, height + 2 * pad)
        look = mean_parts if blur.layered else mean_radiance
        return look(shown, padded, spp, job.seed)

    def radiance(self, job: RenderJob, *, spp: int | None = None) -> Floats:
        """Mean radiance of each pixel times cos^4 of its field angle (mW/mm^2/sr), before lens and glints."""
        shown, _ = self.bind(job)
        return mean_radiance(shown, job.window, spp or self.spp, job.seed)[0].astype(float)

    def iris_irradiance(self, job: RenderJob, points_mm: Floats) -> Floats:
        """Irradiance (n,) mW/mm^2 of points (n, 3) of the iris' plane (eye frame, mm) from all lamps.

        A lamp of finite size is represented by its centre.
        """
        shown, _ = self.bind(job, lit=False)
        shown.lights.on_iris = shown.lights.relief = None
        x = mi.Vector3f(*np.asarray(points_mm, dtype=np.float32).T)
        corner = mi.Float(0)  # of the unit square, which is the disc's centre
        inside = dr.full(mi.Bool, True, len(points_mm))
        bent, _ = through_cornea(shown.values, shown.lights, shown.scene, x, inside, corner, corner)
        return np.asarray(bent.numpy(), dtype=float)

    def labels(self, job: RenderJob) -> PartLabels:
        """Compute the labels of a window alone."""
        return part_labels(self.bind(job, lit=False)[0], job.window)

    def depths_mm(self, job: RenderJob) -> Singles:
        """Distances (height, width) from the nodal point of what a window shows, infinite where that is nothing."""
        return depths_mm(self.bind(job, lit=False)[0], job.window)

    def bind(self, job: RenderJob, *, lit: bool = True) -> tuple[Exposed, Surround | RegionScene]:
        """Set up a job's frame on the device, with the surroundings of its eye.

        It is valid until the next call. `lit`: whether radiance is wanted, not only what is seen where.
        """
        return self._stage.set(job, lit=lit)


def _marks(job: RenderJob, shown: Exposed, place: Surround | RegionScene) -> tuple[Any, ...]:
    """Labels, margins of the lids (px) and highlights of a window, as far as they are wanted."""
    labels = part_labels(shown, job.window) if job.labels else None
    margins = lid_margins_px(place.posed, job.camera, job.anchor_mm) if isinstance(place, RegionScene) else None
    return labels, margins, highlights(shown, job.window) if job.highlights else None
