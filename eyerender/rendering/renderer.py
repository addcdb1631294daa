"""Render jobs as windows of the sensor, with NumPy on both sides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.arrays import Bools, Floats, Ints, Singles, frozen
from ..rig.camera import Window
from .glints.splatting import MirrorImages, Shine
from .integrator.film import Means, coarse_sensor, mean_radiance, start
from .integrator.framebuilder import FrameBuilder
from .integrator.hostdata import BoundFrame, HostData
from .integrator.lensmirror import mirrored_surroundings
from .output.geometry import Hits, window_hits
from .output.labels import PartLabels, annotated_parts, highlights, part_labels
from .output.window import Exposed, RawFrame, RenderedWindow
from .records.job import RenderJob, SubFrames
from .records.recording import uncollected
from .scene.background import Background
from .scene.blur import Blur
from .scene.region import RegionScene

if TYPE_CHECKING:
    from ..backends.choose import Backend

_SIZES = 32  # px


class Renderer:
    """Renderer of jobs on one backend.

    Kernels are compiled once per structure of the eye; all numbers may change between jobs.

    Args:
        backend: the backend.
        spp: samples per pixel.
    """

    def __init__(self, backend: Backend, *, spp: int = 16) -> None:
        self.backend = backend
        self.spp = spp
        self._beside = ThreadPoolExecutor(1, "develop")
        self._builder = FrameBuilder(self._beside)

    def render(self, job: RenderJob, *, spp: int | None = None, moments: Sequence[SubFrames] = ()) -> RenderedWindow:
        """Render one window.

        Args:
            job: the job to render.
            spp: samples per pixel; None: the renderer's default.
            moments: sub-frames of an exposure with motion, which share the samples. Glints and margins are those of
                `job`, at mid-exposure; so are raster labels, where no sub-frame gives them.

        Raises:
            InputError: numbers so extreme that the image is not finite.
        """
        return self._traced(job, spp, moments, None).develop()

    def begin(
        self,
        job: RenderJob,  # the job to render
        *,
        spp: int | None = None,  # as in `render`
        moments: Sequence[SubFrames] = (),  # as in `render`
        # the next job, if known; its host data are then computed in the second thread too. The next call must pass the
        # same object
        after: RenderJob | None = None,
    ) -> Future[RenderedWindow]:
        """Trace a window now; lens and sensor run in a second thread while the next window is traced.

        The result equals that of `render`, whatever comes next.
        """
        return self._beside.submit(self._traced(job, spp, moments, after).develop)

    @uncollected
    def _traced(
        self, job: RenderJob, spp: int | None, moments: Sequence[SubFrames], after: RenderJob | None
    ) -> RawFrame:
        """Trace a job, or the sub-frames of its exposure; take labels and glints from mid-exposure."""
        parts = moments or (SubFrames(jobs=(job,)),)
        shots = [(shot, part) for part in parts for shot in part.jobs]
        # The light that moments share is that of the middle, from which they differ least; lids move little from each
        # moment to the next.
        middle = len(shots) // 2
        shots = shots[middle::-1] + shots[middle + 1 :]
        film = _Film(spp or self.spp, parts)
        blur: Blur | None = None
        pictures: dict[int, list[Singles]] = {id(part): [] for part in parts}
        glints: dict[int, list[Shine]] = {id(part): [] for part in parts}
        in_lenses: dict[int, list[Singles]] = {id(part): [] for part in parts}
        failed = 0
        marks: tuple[Any, ...] | None = None
        rows: list[tuple[Ints, int, PartLabels]] = []
        around: Callable[[], Singles] | None = None
        lit: dict[tuple[float, ...], BoundFrame] = {}  # the last frame under each state of the lamps
        images: MirrorImages | None = None
        for shot, part in shots:
            lamps = _lamps(shot)
            bound, surroundings = self._builder.set(shot, after=None if moments else after, before=lit.get(lamps))
            lit[lamps] = bound
            blur = blur or (Blur.of(job, surroundings.posed) if moments else bound.host.blur)
            means = film.start(bound, blur, part)
            mirror = mirrored_surroundings(bound, blur.window, film.each, shot.seed)
            if shot is shots[0][0]:
                around = coarse_sensor(bound)
            # The device works until something is read, so host work comes first.
            found = _marks(bound, job, surroundings) if _is_middle(shot, job) else None
            there = _inside(job.window, None, part.labelled)
            own = None if part.labelled is None else part_labels(bound, there)
            self._builder.prepare()
            images = self._mirror_images(bound.host, images)
            mirrored, shines = images.seen(surroundings, blur, 1 / len(part.jobs))
            glints[id(part)] += shines
            mean, missed = means()
            if mirror is not None:
                in_lenses[id(part)].append(mirror())
            pictures[id(part)].append(mean)
            failed += missed
            if found is not None:
                marks = mirrored, *found()
            if own is not None and part.labelled is not None:
                rows.append((np.flatnonzero(part.labelled), there[1] - job.window[1], own()))
        assert blur is not None
        if marks is None:  # no sub-frame is at mid-exposure
            bound, surroundings = self.bind(job, lit=False)
            marks = self._mirror_images(bound.host).seen(surroundings, blur)[0], *_marks(bound, job, surroundings)()
        mirrored, labels, margins, bright, hits = marks
        exposed = tuple(_exposed(part, pictures[id(part)], glints[id(part)], in_lenses[id(part)]) for part in parts)
        return RawFrame(
            job=job, exposed=exposed, blur=blur, mirrored=mirrored, labels=_by_rows(labels, rows), failed=failed,
            lid_margins_px=margins, highlights=bright, hits=hits, around=None if around is None else around(),
        )  # fmt: skip

    def _mirror_images(self, host: HostData, before: MirrorImages | None = None) -> MirrorImages:
        """Compute the lamps' mirror images, in the closed-form cornea or its mesh."""
        job = host.job
        if job.mesh_edge_mm is None and before is None:
            return host.mirror_images
        mesh = None if job.mesh_edge_mm is None else self._builder.meshes.of(job.eye, job.mesh_edge_mm)[0]
        return MirrorImages.of(job, mesh, before)

    def radiance(self, job: RenderJob, *, spp: int | None = None) -> Floats:
        """Render the mean of radiance times cos^4(theta) / D (mW/mm^2/sr) per pixel, before lens and glints."""
        bound, _ = self.bind(job)
        return mean_radiance(bound, job.window, spp or self.spp, job.seed)[0].astype(float)

    def labels(self, job: RenderJob) -> PartLabels:
        """Compute only the labels of a window."""
        return part_labels(self.bind(job, lit=False)[0], job.window)()

    def bind(self, job: RenderJob, *, lit: bool = True) -> tuple[BoundFrame, Background | RegionScene]:
        """Set up a job's frame on the device, with the surroundings of its eye; both are valid until the next call.

        lit: whether to compute light, not only geometry.
        """
        return self._builder.set(job, lit=lit)


def _exposed(part: SubFrames, pictures: list[Singles], glints: list[Shine], in_lenses: list[Singles]) -> Exposed:
    """Average the light of the moments of a part of an exposure."""
    mean = pictures[0] if len(pictures) == 1 else np.mean(pictures, axis=0)
    return Exposed(mean, tuple(glints), part.rows, np.mean(in_lenses, axis=0) if in_lenses else None)


def _lamps(job: RenderJob) -> tuple[float, ...]:
    """Return the state of a job's lamps."""
    return tuple(lamp.intensity_mw_sr for lamp in job.lights)


class _Film:
    """Renders the moments of an exposure; under the same lamps, they differ only in what moves and in their rows.

    Args:
        spp: samples per pixel of the whole exposure.
        parts: its moments.

    Attributes:
        each: samples per pixel of a moment.
    """

    def __init__(self, spp: int, parts: Sequence[SubFrames]) -> None:
        self._spp, self.each = spp, max(1, spp // _shots_of_a_row(parts))
        self._still: dict[tuple[float, ...], Singles] = {}

    def start(self, bound: BoundFrame, blur: Blur, part: SubFrames) -> Means:
        """Start rendering a moment, as `film.start` does."""
        job, whole = bound.host.job, blur.window
        base = self._still.get(_lamps(job))
        if base is None:
            stands = _inside(whole, part.moving) != whole
            means = start(bound, whole, self._spp if stands else self.each, job.seed, layered=blur.layered)
            window = whole
        else:
            window = _inside(whole, part.moving, part.rows)
            means = start(bound, window, self.each, job.seed, layered=blur.layered)

        def read() -> tuple[Singles, int]:
            mean, failed = means()
            picture = mean if base is None else base.copy()
            x, y = window[0] - whole[0], window[1] - whole[1]
            picture[..., y : y + window[3], x : x + window[2]] = mean
            self._still.setdefault(_lamps(job), picture)
            return picture, failed

        return read


def _inside(window: Window, part: Window | None, rows: Floats | Bools | None = None) -> Window:
    """Return a part of a window, in those of its rows that get light; all of it without a part.

    Its sizes are multiples of `_SIZES`, because each size has recordings of its own. `rows` are those of the window
    without the border that the lens needs.
    """
    low, size = np.array(window[:2]), np.array(window[2:])
    first, last = (low, low + size) if part is None else (np.array(part[:2]), np.add(part[:2], part[2:]))
    if rows is not None:
        pad, lit = (window[3] - len(rows)) // 2, np.flatnonzero(rows)
        first = np.maximum(first, [first[0], low[1] + lit[0]])
        last = np.minimum(last, [last[0], low[1] + lit[-1] + 2 * pad + 1])
    first = np.clip(first, low, low + size - 1)
    wanted = np.clip(last, first + 1, low + size) - first
    wanted = np.minimum(-(-wanted // _SIZES) * _SIZES, size)
    first = np.minimum(first, low + size - wanted)
    return int(first[0]), int(first[1]), int(wanted[0]), int(wanted[1])


def _shots_of_a_row(parts: Sequence[SubFrames]) -> int:
    """Return how many pictures the samples of a row are divided among, at most."""
    counts = [len(part.jobs) * (np.ones(1) if part.rows is None else part.rows > 0) for part in parts]
    return max(1, int(np.max(np.asarray(sum(counts)))))


def _is_middle(shot: RenderJob, job: RenderJob) -> bool:
    """Return whether a sub-frame shows the eye, its lids and the camera where the job at mid-exposure has them."""
    return all(getattr(shot, name) is getattr(job, name) for name in ("M", "t", "camera", "region", "eye"))


def _by_rows(labels: PartLabels | None, rows: Sequence[tuple[Ints, int, PartLabels]]) -> PartLabels | None:
    """Put raster labels together whose rows are exposed at different times: which rows, and where the labels begin."""
    if labels is None or not rows:
        return labels
    part, amodal = np.array(labels.part), np.array(labels.amodal)
    for which, first, own in rows:
        part[which], amodal[which] = own.part[which - first], own.amodal[which - first]
    return replace(labels, part=frozen(part, part.dtype), amodal=frozen(amodal, amodal.dtype))


def _marks(
    bound: BoundFrame, job: RenderJob, surroundings: Background | RegionScene
) -> Callable[[], tuple[PartLabels | None, Any, Bools | None, Hits | None]]:
    """Start computing labels, margins of the lids (px), highlights and geometry, as far as the job wants them."""
    hits = window_hits(bound, job, surroundings) if job.geometry else lambda: None
    labels = part_labels(bound, job.window) if job.labels and not job.geometry else lambda: None
    drawn = annotated_parts(bound, job.window) if job.annotated and job.region is not None else None

    def read() -> tuple[PartLabels | None, Any, Bools | None, Hits | None]:
        found = hits()
        bright = highlights(bound, job.window) if job.highlights else None
        parts = labels() if found is None else found.labels
        if job.annotated and parts is not None:
            parts = replace(parts, annotated=parts.part if drawn is None else drawn())
        return parts, bound.host.lid_margins_px, bright, found

    return read
