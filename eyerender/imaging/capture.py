"""Render frames in memory, with a window of the sensor for each eye."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..backends.choose import BackendChoice, choose_backend
from ..base.arrays import Bytes, Floats, Singles
from ..base.errors import InputError
from ..base.progress import COMPILING, Progress, followed_by, one_behind
from ..eye.landmarks import at_cornea_d
from ..eye.legs import apparent_places
from ..eye.model import EyeModel
from ..folders.imagefile import MAX_PIXELS, compressed
from ..region.anatomy import Region
from ..rig.camera import Window
from ..rig.rig import RigGeometry
from ..rig.stray import misses_light
from ..scene.observation import EYES
from .moments import eye_motion, moments, rest_mm
from .renderable import RenderableFrames, RenderableScene, RenderableSource, posed_frames

if TYPE_CHECKING:
    from ..rendering.output.window import RenderedWindow
    from ..rendering.records.job import RenderJob, SubFrames
    from ..rendering.renderer import Renderer

# For one image, this is a day's work for a fast processor.
MAX_SAMPLES = 10**12


@dataclass(frozen=True, slots=True, eq=False)
class EyeImage:
    """A rendered image of one eye: a window of a camera's sensor.

    >>> image = er.render(er.load_scene("headset").frames()[0])  # doctest: +SKIP
    >>> image.counts.shape  # doctest: +SKIP

    Attributes:
        frame: the row of frames that it shows.
        row: index of that row among the rendered frames.
        window: (x0, y0, width, height) of the window in full-sensor pixels.
        counts: counts stored by the sensor, (height, width) uint8 or uint16 DN.
        irradiance: irradiance of the sensor before noise and quantisation, (height, width) W/m^2.
        parts: part of the eye at each pixel's centre, (height, width) uint8 (docs/formats.md).
        eye: the eye's model, placed in the world by x_world = M x + t.
        M: (3, 3) rotation of that motion.
        t: (3,) translation of that motion, mm.
        rendered: the renderer's complete result.
    """

    frame: RenderableFrames
    row: int
    window: Window
    counts: NDArray[Any]
    irradiance: Singles
    parts: Bytes
    eye: EyeModel
    M: Floats
    t: Floats
    rendered: RenderedWindow

    @property
    def name(self) -> str:
        """Name of the image's files: the number of the frame and the eye."""
        index = self.frame.index
        return f"{index.frame[0]:06d}_{EYES[index.eye[0]]}"

    @property
    def lens_reflections(self) -> Bytes:
        """1 where lenses mirror more light than comes from behind them, else 0, (height, width)."""
        found = self.rendered.lens_reflections
        return np.zeros(self.parts.shape, np.uint8) if found is None else np.asarray(found, np.uint8)

    @property
    def apex_mm(self) -> Floats:
        """Apex of the unrotated eye in the world, (3,) mm."""
        return rest_mm(self.frame, 0)

    @property
    def scene(self) -> RenderableScene:
        """Scene that was rendered."""
        return self.frame.scene

    @property
    def camera(self) -> int:
        """Index of the camera."""
        return int(self.frame.index.camera[0])

    @property
    def rig(self) -> RigGeometry:
        """Rig in the world, as it stands in this frame."""
        return self.scene.rig_at(self.frame.index, 0)

    @property
    def region(self) -> Region | None:
        """Region of the eye, with its lids as they are in this frame."""
        return self.scene.region_at(self.frame.index, 0)


def render_windows(
    frames: RenderableFrames | RenderableSource,
    *,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    renderer: Renderer | None = None,
    progress: Progress | None = None,
) -> Iterator[EyeImage]:
    """Render every row of `frames` in its own window, in order.

    >>> windows = list(er.render_windows(er.load_scene("headset")))  # doctest: +SKIP

    Args:
        frames: n rows, one eye in one frame each, or a scene for all of its frames.
        backend: the backend, if no renderer is given.
        threads: number of processor threads for rendering; None: all.
        renderer: an existing renderer (see `make_renderer`).
        progress: called with (images done, n, note) after each image.

    Raises:
        InputError: the scene's windows cannot be rendered.
        BackendError: no backend renders; the message says how to fix it.
    """
    frames = posed_frames(frames)
    check_windows(frames.scene)
    if renderer is None:
        renderer = make_renderer(backend, threads)
    images = (frame.image() for frame in one_behind(begin_each([frames], renderer)))
    yield from followed_by(images, len(frames), progress, "images", COMPILING)


@dataclass(frozen=True, slots=True, eq=False)
class BegunImage:
    """Image in progress of a traced row of `frames`; a second thread completes it."""

    frames: RenderableFrames
    row: int
    job: RenderJob
    made: Future[RenderedWindow]

    def image(self) -> EyeImage:
        """Wait for the image."""
        done, job = self.made.result(), self.job
        assert done.labels is not None
        return EyeImage(
            frame=self.frames.take([self.row]),
            row=self.row,
            window=done.window,
            counts=stored(self.frames.scene, done.dn),
            irradiance=done.irradiance,
            parts=done.labels.part,
            eye=job.eye,
            M=job.M,
            t=job.t,
            rendered=done,
        )


def begin_each(
    many: Iterable[RenderableFrames],  # the frames, one scene after the other
    renderer: Renderer,  # what traces them
    *,
    highlights: bool = False,  # whether to find the highlights of wet and oily surfaces
    annotated: bool = False,  # whether to compute the masks that people would draw
    geometry: tuple[str, ...] = (),  # kinds of geometry to find: depth, normals, iris_coordinates, instances
) -> Iterator[BegunImage]:
    """Trace the rows of many frames in order; a second thread turns each trace into an image meanwhile.

    The next frames are fetched before the last ones are traced, so that a second thread can prepare them. If fetching
    fails, the frames fetched so far are traced first.

    Raises:
        InputError: a scene's windows cannot be rendered.
    """
    steps = _steps(many, {"highlights": highlights, "annotated": annotated, "geometry": geometry})
    step = next(steps, None)
    while step is not None:
        failed: Exception | None = None
        try:
            after = next(steps, None)
        except Exception as error:
            after, failed = None, error
        spp, expected = step.frames.scene.spec.image.spp, None if after is None or after.moments else after.job
        made = renderer.begin(step.job, spp=spp, moments=step.moments, after=expected)
        yield BegunImage(step.frames, step.row, step.job, made)
        if failed is not None:
            raise failed
        step = after


@dataclass(frozen=True, slots=True)
class _Step:
    """The job of a row of `frames`, and its moments, if it moves."""

    frames: RenderableFrames
    row: int
    job: RenderJob
    moments: tuple[SubFrames, ...]


def _steps(many: Iterable[RenderableFrames], wanted: dict[str, Any]) -> Iterator[_Step]:
    """Make the jobs to trace, one after the other; `wanted` are fields of theirs."""
    for frames in many:
        check_windows(frames.scene)
        for row in range(len(frames)):
            job = replace(render_job(frames, row), **wanted)
            yield _Step(frames, row, job, moments(frames, row, job, render_job))


def render_job(frames: RenderableFrames, row: int) -> RenderJob:
    """Create the renderer's job for one row: the eye in its pose, the rig, the window, the seed."""
    from ..rendering.records.job import RenderJob

    scene, index = frames.scene, frames.index
    camera, head = int(index.camera[row]), int(index.head[row])
    M, t = eye_motion(frames, row)
    # Each image has its own seed, a pure function of the scene's seed, the instant, the eye and the place of the camera
    # among those that see the eye: other cameras do not change an eye's pictures.
    side = EYES[index.eye[row]]
    rank = sum(other.sees(side) for other in scene.rig.cameras[:camera])
    seeds = np.random.SeedSequence(
        [scene.spec.seed, int(index.instant[row]), int(index.eye[row]), *([rank] if rank else [])]
    )
    rig = scene.rig_at(index, row)
    lights = tuple(rig.lights[k] for k in rig.lights_of(int(index.eye[row])))
    if not lights:
        raise InputError(f"none lights the {side} eye; name it in `eyes` of one", path="rig.lights")
    view, window = rig.cameras[camera], scene.window(camera, head, int(index.eye[row]))
    return RenderJob(
        eye=scene.eye_at(index, row),
        M=M,
        t=t,
        camera=view.unflipped,
        window=view.turned(window) if view.flip else window,
        flip=view.flip,
        lights=lights,
        sensor=scene.spec.sensor,
        look=scene.spec.look,
        region=scene.region_at(index, row),
        lens=scene.spec.lens,
        ambient=scene.ambient,
        mesh_edge_mm=scene.spec.image.mesh_edge_mm if scene.spec.image.surfaces == "mesh" else None,
        purkinje=(
            1,
            *(order for order in scene.spec.image.purkinje if order in scene.eye_at(index, row).purkinje_orders),
        ),
        interreflection=scene.spec.image.interreflection,
        wavelength_nm=scene.spec.wavelength_nm,
        seed=int(seeds.generate_state(1, np.uint64)[0]),
        apex_mm=rest_mm(frames, row),
        focus_dpt=focus_dpt(frames, row),
        obstacles=rig.bodies(),
    )


def focus_dpt(frames: RenderableFrames, row: int) -> float:
    """Compute the vergence (D) at which the eye of one row is focused.

    If the scene states the accommodation, as for drawn people, the eye is focused that much nearer than its far point.
    Otherwise it is focused on its target, or far away without one, unless it is too short-sighted. A contact lens moves
    the far point.
    """
    scene, index = frames.scene, frames.index
    side = EYES[index.eye[row]]
    far = -at_cornea_d(scene.refraction_d(side))
    if (contact := scene.contact_lens(side)) is not None:
        far += contact.power_d
    if (accommodation := scene.accommodation_d) is not None:
        return far + accommodation
    gap = index.target_mm[row] - (index.eye_position_mm[row] + index.head_mm[row])
    eye = scene.eye(side, tuple(index.head_mm[row]))
    if eye.worn and np.isfinite(gap).all():
        gap = apparent_places(eye.worn, gap[None])[0]
    target = 1e3 / float(np.linalg.norm(gap)) if np.isfinite(gap).all() else 0.0
    return max(target, far)


def check_windows(scene: RenderableScene) -> None:
    """Check that the eyes of a scene can be rendered. Raises InputError if they cannot."""
    if scene.spec.image.surfaces == "mesh":
        scene.refuse_spectacles("meshes of the eye are rendered")
    if scene.spec.image.purkinje:
        scene.refuse_spectacles("further Purkinje images are rendered")
    if scene.rig.obstacles and scene.region is not None and scene.region.head is not None:
        raise InputError("are not drawn around head meshes so far", path="rig.obstacles")
    spp = scene.spec.image.spp
    for i in range(len(scene.rig.cameras)):
        width, height = scene.window_size_px(i)
        if width * height > MAX_PIXELS:
            what = "image.window_px" if scene.spec.image.window_px else f"rig.cameras.{i}.resolution_px"
            raise InputError(
                f"{width} x {height} pixels are too many to render; at most {MAX_PIXELS} are allowed", path=what
            )
        camera = scene.rig.cameras[i]
        whole = camera.resolution_px[0] * camera.resolution_px[1]
        if whole > MAX_PIXELS and misses_light(scene.spec.lens, camera, (0, 0, width, height)):
            raise InputError(
                f"{whole} pixels are too many for lens.glare and lens.ghost, which scatter light of the whole sensor; "
                f"at most {MAX_PIXELS} are allowed",
                path=f"rig.cameras.{i}.resolution_px",
            )
        if width * height * spp > MAX_SAMPLES:
            raise InputError(
                f"{width} x {height} pixels with {spp} samples each are more than {MAX_SAMPLES:.0e} samples",
                path="image.spp",
            )


def make_renderer(backend: BackendChoice = "auto", threads: int | None = None) -> Renderer:
    """Create a renderer on a backend that works.

    Raises:
        BackendError: no backend renders; the message says how to fix it.
    """
    chosen = choose_backend(backend, threads)
    # Importing the renderer imports mitsuba, which requires a backend that is set up.
    from ..rendering.renderer import Renderer

    return Renderer(chosen)


def noiseless(image: EyeImage) -> NDArray[Any]:
    """Compute the counts of an image without the sensor's noise, as with `sensor.noise: false`."""
    from ..rig.exposure import recorded

    spec = image.scene.spec
    sensor = spec.sensor.model_copy(update={"noise": False})
    camera = image.rig.cameras[image.camera]
    dn = recorded(sensor, camera, image.window, image.irradiance.astype(float), spec.wavelength_nm, 0)
    return dn.astype(np.uint8) if sensor.bit_depth == 8 else dn


def stored(scene: RenderableScene, dn: NDArray[np.uint16]) -> NDArray[Any]:
    """Convert counts to the stored type, through the sensor's compression."""
    sensor = scene.spec.sensor
    if sensor.bit_depth != 8:
        return dn
    codes = dn.astype(np.uint8)
    return codes if sensor.jpeg_quality is None else compressed(codes, sensor.jpeg_quality)
