"""The renderer of the live page, in its own thread.

Each tab has at most one order: the frame to show. A new order replaces the old one, so a slider that moves faster than
frames render leaves no queue behind. A new order is first answered with a preview of a few samples, with coarse pixels
if fine ones would take too long. While nothing changes, passes over the whole window refine the image to 4, 8, 16, 32
and 64 samples per pixel. A pass renders the window in bands, and the thread checks for new orders between them. Tabs
take turns, and previews come before passes.
"""

from __future__ import annotations

import io
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...backends.choose import BackendChoice
from ...base.arrays import Bytes, Floats, Reals, frozen
from ...base.errors import EyerenderError, one_line
from ...folders.imagefile import preview
from ...imaging.capture import EyeImage, check_windows, make_renderer, render_job, stored
from ...imaging.imageobserver import detect
from ...imaging.moments import moments
from ...rig.camera import Window
from ...rig.defocus import vignette
from ...rig.exposure import radiance_to_irradiance, recorded
from ...rig.plausibility import is_saturated
from ...rig.stray import framed, scattered
from ...scene import Frames
from ...scene.observation import Observations

if TYPE_CHECKING:
    from ...rendering.output.window import RenderedWindow
    from ...rendering.records.job import RenderJob
    from ...rendering.renderer import Renderer

PREVIEW_SPP = 4
GOAL_SPP = 64
BUDGET_S = 0.2
"""Longest desired time of a preview, or of a band of a pass."""
PREVIEW_PX = (20_000, 160_000, 640_000)
"""Pixels of a preview: the fewest, those of the first one, and the most."""
REST_S = 0.25
"""Time without changes after a preview before its image is refined."""
BAND_SAMPLES = 640_000
"""Fewest samples of a band: rendering these takes about as long as preparing a band."""
MAX_REASON = 300


@dataclass(frozen=True, slots=True)
class Order:
    """A tab's request for an image."""

    number: int  # number of the order, counted per tab
    frame: Frames  # one row: the eye in its pose, and the scene
    extract: bool = True  # whether to extract the features from the image


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Shown:
    """Answer to an order: an image, or the problem that prevents it."""

    number: int  # number of the order
    samples: int = 0  # samples per pixel so far
    coarse: int = 1  # side of the preview's pixels, in sensor pixels; 1 for a full-resolution image
    size_px: tuple[int, int] = (0, 0)  # width and height of the picture
    window: Window = (0, 0, 0, 0)  # the window of the sensor
    data: bytes = b""  # the image as a file, brightened for viewing
    kind: str = ""  # media type of that file
    found: Observations | None = None  # the extracted features; None if they were not requested
    hidden: tuple[str, ...] = ()  # for each light, what hides its glint ("" for a visible one)
    saturated: bool = False  # whether the picture is saturated
    seconds: float = 0.0  # time of the last rendering
    problem: str = ""  # one line that describes why there is no image; None if there is one


Deliver = Callable[[Shown], None]


@dataclass(slots=True, eq=False, kw_only=True)
class _Canvas:
    """Work in progress on one order: the mean of its passes."""

    order: Order
    since: float  # time of the order, or of its first image
    mean: Floats | None = None
    samples: int = 0
    hidden: tuple[str, ...] = ()


@dataclass(slots=True, eq=False)
class _Tab:
    deliver: Deliver
    canvas: _Canvas | None = None
    fresh: bool = False  # the canvas waits for its preview


@dataclass(slots=True)
class Pace:
    """Allowed number of pixels of a preview, from the measured times of earlier previews."""

    pixels: int = PREVIEW_PX[1]
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=3))

    def coarse(self, pixels: int) -> int:
        """Choose the width of a preview's pixels, in sensor pixels, for a window of this size."""
        return math.ceil(math.sqrt(pixels / self.pixels))

    def took(self, seconds: float) -> None:
        """Update the pace with the time of a preview; a single slow one has no effect, as the first one compiles."""
        self._times.append(seconds)
        if len(self._times) < 3:
            return
        middle = sorted(self._times)[1]
        if middle > BUDGET_S:
            self._become(self.pixels // 2)
        elif middle < BUDGET_S / 4:
            self._become(self.pixels * 2)

    def _become(self, pixels: int) -> None:
        self.pixels = min(max(pixels, PREVIEW_PX[0]), PREVIEW_PX[2])
        self._times.clear()


@dataclass(slots=True, eq=False, kw_only=True)
class Painter:
    """Renderer for the orders of all tabs; call `start` first and `close` at the end.

    Args:
        backend: the render backend.
        threads: processor threads for rendering; None: all.
        goal: samples per pixel at which an image is finished.
    """

    backend: BackendChoice = "auto"
    threads: int | None = None
    goal: int = GOAL_SPP
    _tabs: dict[str, _Tab] = field(default_factory=dict)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _stopped: bool = False
    _thread: threading.Thread | None = None
    _failure: Exception | None = None
    _pace: Pace = field(default_factory=Pace)
    _sample_s: float = 1e-6  # time of the last band per sample

    def start(self) -> None:
        """Start the renderer in its thread; BackendError if no backend renders."""
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="painter", daemon=True)
        self._thread.start()
        ready.wait()
        if self._failure is not None:
            raise self._failure

    def open(self, key: str, deliver: Deliver) -> None:
        """Register a tab; `deliver` is called in the painter's thread."""
        with self._changed:
            self._tabs[key] = _Tab(deliver)

    def ask(self, key: str, order: Order) -> None:
        """Replace the order of a tab."""
        with self._changed:
            tab = self._tabs.get(key)
            if tab is not None:
                tab.canvas, tab.fresh = _Canvas(order=order, since=time.monotonic()), True
                self._changed.notify()

    def drop(self, key: str) -> None:
        """Forget a tab and its images."""
        with self._changed:
            self._tabs.pop(key, None)
            self._changed.notify()  # a waiting thread would still refer to the tabs in its local variables

    def close(self) -> None:
        """Stop after the current band."""
        with self._changed:
            self._stopped = True
            self._tabs.clear()
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(timeout=10)

    def _run(self, ready: threading.Event) -> None:
        try:
            renderer = make_renderer(self.backend, self.threads)
        except Exception as error:
            self._failure = error
            return
        finally:
            ready.set()
        while (work := self._next()) is not None:
            tab, canvas, fresh = work
            try:
                for shown in self._preview(renderer, canvas) if fresh else self._pass(renderer, tab, canvas):
                    if not self._stopped:
                        tab.deliver(shown)
            except Exception as error:
                tab.deliver(Shown(number=canvas.order.number, problem=line_of(error)))
                canvas.samples = self.goal
            if fresh:
                canvas.since = time.monotonic()
            del work, tab, canvas  # these names would keep alive what a tab that closes meanwhile should free

    def _next(self) -> tuple[_Tab, _Canvas, bool] | None:
        """Wait for work: the oldest order without a preview, else the resting tab with the fewest samples."""
        with self._changed:
            while not self._stopped:
                tabs = [(tab, tab.canvas) for tab in self._tabs.values() if tab.canvas is not None]
                fresh = [(canvas.since, k) for k, (tab, canvas) in enumerate(tabs) if tab.fresh]
                if fresh:
                    tab, canvas = tabs[min(fresh)[1]]
                    tab.fresh = False
                    return tab, canvas, True
                unfinished = [(tab, canvas) for tab, canvas in tabs if canvas.samples < self.goal]
                rest = [canvas.since + REST_S - time.monotonic() for _, canvas in unfinished]
                rested = [pair for pair, left in zip(unfinished, rest, strict=True) if left <= 0]
                if rested:
                    tab, canvas = min(rested, key=lambda pair: pair[1].samples)
                    return tab, canvas, False
                self._changed.wait(min(rest) if rest else None)
        return None

    def _busy(self, tab: _Tab, canvas: _Canvas) -> bool:
        """Return whether another task is more urgent than a pass of this canvas."""
        with self._changed:
            return self._stopped or tab.canvas is not canvas or any(other.fresh for other in self._tabs.values())

    def _preview(self, renderer: Renderer, canvas: _Canvas) -> Iterator[Shown]:
        """Deliver the first image of an order at once, and again with the features extracted from it."""
        frame = canvas.order.frame
        check_windows(frame.scene)
        job = _job(frame, 0)
        _, _, width, height = job.window
        began = time.perf_counter()
        coarse = self._pace.coarse(width * height)
        shrunk = coarser(job, coarse)
        done = renderer.render(shrunk, spp=PREVIEW_SPP, moments=moments(frame, 0, shrunk, render_job))
        seconds = time.perf_counter() - began
        self._pace.took(seconds)
        canvas.hidden = done.glint_reasons
        irradiance = enlarged(done.irradiance, coarse, (width, height))
        image = _image(canvas, job, done, irradiance)
        shown = _shown(canvas, image, PREVIEW_SPP, seconds, coarse=coarse)
        yield shown
        if canvas.order.extract:
            yield replace(shown, found=detect(image))

    def _pass(self, renderer: Renderer, tab: _Tab, canvas: _Canvas) -> Iterator[Shown]:
        """Render one pass over the window, in bands; an interrupted pass changes nothing."""
        frame = canvas.order.frame
        job = _job(frame, canvas.samples + 1)
        x0, y0, width, height = job.window
        spp = max(PREVIEW_SPP, canvas.samples)
        rows = max(1, min(height, int(max(BAND_SAMPLES, BUDGET_S / self._sample_s)) // (spp * width)))
        taken = np.zeros((height, width))
        began = time.perf_counter()
        for top in range(0, height, rows):
            if self._busy(tab, canvas):
                return
            band = replace(job, window=(x0, y0 + top, width, min(rows, height - top)))
            start = time.perf_counter()
            done = renderer.render(band, spp=spp, moments=moments(frame, 0, band, render_job))
            self._sample_s = (time.perf_counter() - start) / (spp * done.irradiance.size)
            taken[top : top + rows] = done.irradiance
        seconds = time.perf_counter() - began
        share = spp / (canvas.samples + spp)
        canvas.mean = taken if canvas.mean is None else canvas.mean + share * (taken - canvas.mean)
        canvas.samples += spp
        image = _image(canvas, job, done, canvas.mean)
        shown = _shown(canvas, image, canvas.samples, seconds, last=canvas.samples >= self.goal)
        yield replace(shown, found=detect(image)) if canvas.order.extract else shown


def coarser(job: RenderJob, side: int) -> RenderJob:
    """Make the pixels of a job's window `side` times as wide, as if the sensor had such pixels.

    Pixel centres lie at integers, so pixel u of the window holds the pixels side u to side u + side - 1.
    """
    if side == 1:
        return job
    x0, y0, width, height = job.window
    old = job.camera
    K = old.K.copy()
    K[0, 2], K[1, 2] = (np.array([K[0, 2] - x0, K[1, 2] - y0]) + 0.5) / side - 0.5
    K[0, 0], K[1, 1] = K[0, 0] / side, K[1, 1] / side
    size = (-(-width // side), -(-height // side))
    camera = replace(old, K=frozen(K), resolution_px=size)
    sensor = job.sensor.model_copy(
        update={"pixel_pitch_um": job.sensor.pixel_pitch_um * side, "psf_sigma_px": job.sensor.psf_sigma_px / side}
    )
    return replace(job, camera=camera, sensor=sensor, window=(0, 0, *size))


def enlarged(picture: NDArray[Any], side: int, size_px: tuple[int, int]) -> Floats:
    """Enlarge a coarse image (h, w) to full size, interpolating between pixel centres."""
    if side == 1:
        return np.asarray(picture, dtype=float)
    width, height = size_px
    image = Image.fromarray(np.asarray(picture, dtype=np.float32))
    wide = image.resize((image.width * side, image.height * side), Image.Resampling.BILINEAR)
    return np.asarray(wide, dtype=float)[:height, :width]


def _job(frame: Frames, draw: int) -> RenderJob:
    """Create the job of a pass, with new samples and without the effects that `developed` applies to the image."""
    job = render_job(frame, 0)
    seed = int(np.random.SeedSequence([job.seed, draw]).generate_state(1, np.uint64)[0])
    quiet = job.sensor.model_copy(update={"noise": False, "border_px": (0, 0, 0, 0)})
    clear = job.lens.model_copy(update={"vignetting": 0.0, "glare": 0.0, "ghost": 0.0, "openings": ()})
    return replace(job, seed=seed, sensor=quiet, lens=clear, labels=False, flip=False)


def developed(job: RenderJob, irradiance: Floats) -> tuple[Reals, NDArray[np.uint16]]:
    """Compute irradiance (h, w) and codes of the sensor from the mean of all passes of a job.

    Vignetting, openings, scattered light and the sensor belong to the window as a whole, so bands and coarse pixels
    are rendered without them.
    """
    seen = (job.lens, job.camera, job.window)
    picture = irradiance / radiance_to_irradiance(job.sensor) * vignette(*seen)
    behind = scattered(framed(picture, *seen), *seen) * radiance_to_irradiance(job.sensor)
    return behind, recorded(job.sensor, job.camera, job.window, behind, job.wavelength_nm, job.seed)


def _image(canvas: _Canvas, job: RenderJob, done: RenderedWindow, irradiance: Floats) -> EyeImage:
    """Convert a canvas to an image as the sensor stores it, for the extractor."""
    frame = canvas.order.frame
    whole = render_job(frame, 0)
    behind, codes = developed(whole, irradiance)
    if whole.flip:
        behind, codes = behind[:, ::-1], np.ascontiguousarray(codes[:, ::-1])
    return EyeImage(
        frame=frame,
        row=0,
        window=whole.camera.turned(job.window) if whole.flip else job.window,
        counts=stored(frame.scene, codes),
        irradiance=behind.astype(np.float32),
        parts=np.zeros(codes.shape, np.uint8),
        eye=job.eye,
        M=job.M,
        t=job.t,
        rendered=done,
    )


def _shown(
    canvas: _Canvas, image: EyeImage, samples: int, seconds: float, *, coarse: int = 1, last: bool = False
) -> Shown:
    """Encode an image as a file; the last one losslessly."""
    sensor = image.scene.spec.sensor
    kind = "PNG" if last else "JPEG"
    return Shown(
        number=canvas.order.number,
        samples=samples,
        coarse=coarse,
        size_px=image.window[2:],
        window=image.window,
        data=_encoded(_tones(sensor.full_scale_dn)[image.counts], kind),
        kind=f"image/{kind.lower()}",
        hidden=canvas.hidden,
        saturated=is_saturated(image.counts, sensor),
        seconds=seconds,
    )


@lru_cache(maxsize=4)
def _tones(full_scale: int) -> Bytes:
    """Return the screen's grey level for each code of a sensor."""
    return preview(np.arange(full_scale + 1), full_scale)


def _encoded(pixels: Bytes, kind: str) -> bytes:
    buffer = io.BytesIO()
    options = {"compress_level": 1} if kind == "PNG" else {"quality": 88}
    Image.fromarray(pixels).save(buffer, format=kind, **options)
    return buffer.getvalue()


def line_of(error: Exception) -> str:
    """Format an error as one line."""
    if isinstance(error, EyerenderError):
        return one_line(str(error), MAX_REASON)
    if isinstance(error, MemoryError):
        return "out of memory"
    return one_line(f"this frame cannot be rendered ({type(error).__name__}: {error})", MAX_REASON)
