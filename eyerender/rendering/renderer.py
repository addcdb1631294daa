"""The renderer turns jobs into windows of the sensor, with NumPy on both sides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import Bools, Floats, Singles
from ..folders.imagefolder import BACKGROUND, FRAME, IRIS, PUPIL, SCLERA
from .glints.splatting import MirrorImages, Shine
from .integrator.film import mean_radiance, start
from .integrator.framebuilder import FrameBuilder
from .integrator.hostdata import HostData
from .integrator.request import BoundFrame
from .output.labels import PartLabels, highlights, part_labels
from .output.window import RawFrame, RenderedWindow
from .records.job import RenderJob
from .records.recording import uncollected
from .scene.background import Background, Obstacle
from .scene.blur import Blur
from .scene.region import RegionScene

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
        self._beside = ThreadPoolExecutor(1, "develop")
        self._stage = FrameBuilder(self._beside, obstacles)

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

        The result is that of `render`, whatever comes next.

        Args:
            job: what to render.
            spp: as in `render`.
            moments: as in `render`.
            after: the very job that comes next, if it is known: what NumPy alone makes of it is made in the second
                thread, too.
        """
        return self._beside.submit(self._traced(job, spp, moments, after).developed)

    @uncollected
    def _traced(
        self, job: RenderJob, spp: int | None, moments: Sequence[RenderJob], after: RenderJob | None
    ) -> RawFrame:
        """Trace a job, or its moments: the mean of their pictures, with labels and glints of the job itself."""
        shots = moments or (job,)
        spp = max(1, (spp or self.spp) // len(shots))
        blur: Blur | None = None
        pictures: list[Singles] = []
        failed = 0
        glints: list[Shine] = []
        marks: tuple[Any, ...] | None = None
        for shot in shots:
            shown, place = self._stage.set(shot, after=None if moments else after)
            blur = blur or (Blur.of(job, place.posed) if moments else shown.host.blur)
            film = start(shown, blur.window, spp, shot.seed, layered=blur.layered)
            # The device is at work until something is read, so the host's own work comes first.
            found = _marks(shown, job) if shot.M is job.M and shot.t is job.t else None
            self._stage.prepare()
            mirrored, shines = self._mirror_images(shown.host).seen(place, blur, 1 / len(shots))
            glints += shines
            mean, missed = film.means()
            pictures.append(mean)
            failed += missed
            if found is not None:
                marks = mirrored, *found()
        assert blur is not None
        if marks is None:  # no moment is the middle of the exposure
            shown, place = self.bind(job, lit=False)
            marks = self._mirror_images(shown.host).seen(place, blur)[0], *_marks(shown, job)()
        mirrored, labels, margins, bright = marks
        picture = np.mean(pictures, axis=0) if moments else pictures[0]
        return RawFrame(job, picture, tuple(glints), blur, mirrored, labels, failed, margins, bright)

    def _mirror_images(self, host: HostData) -> MirrorImages:
        """The lamps' mirror images, in the closed form of the cornea or in a mesh of it."""
        job = host.job
        if job.mesh_edge_mm is None:
            return host.mirror_images
        return MirrorImages.of(job, self._stage.meshes.of(job.eye, job.mesh_edge_mm)[0])

    def radiance(self, job: RenderJob, *, spp: int | None = None) -> Floats:
        """Mean radiance of each pixel times cos^4 of its field angle (mW/mm^2/sr), before lens and glints."""
        shown, _ = self.bind(job)
        return mean_radiance(shown, job.window, spp or self.spp, job.seed)[0].astype(float)

    def labels(self, job: RenderJob) -> PartLabels:
        """Compute the labels of a window alone."""
        return part_labels(self.bind(job, lit=False)[0], job.window)()

    def bind(self, job: RenderJob, *, lit: bool = True) -> tuple[BoundFrame, Background | RegionScene]:
        """Set up a job's frame on the device, with the surroundings of its eye.

        It is valid until the next call. `lit`: whether radiance is wanted, not only what is seen where.
        """
        return self._stage.set(job, lit=lit)


def _marks(shown: BoundFrame, job: RenderJob) -> Callable[[], tuple[PartLabels | None, Any, Bools | None]]:
    """Begin with labels, margins of the lids (px) and highlights, as far as the job wants them."""
    labels = part_labels(shown, job.window) if job.labels else lambda: None
    return lambda: (
        labels(), shown.host.lid_margins_px, highlights(shown, job.window) if job.highlights else None
    )  # fmt: skip
