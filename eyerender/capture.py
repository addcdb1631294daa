"""Pictures of a scene: every window rendered, with its labels; in memory, or as a folder of images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .analytic.observer import observe
from .arrays import Bytes, Floats, Singles
from .backends.choose import BackendChoice
from .errors import InputError, Warn
from .eye.model import EyeModel
from .eye.pose import Poses, rigid_motion
from .imagefile import MAX_PIXELS, write_png
from .imagefolder import write_dataset
from .observation import EYES, Observations
from .outfolder import refuse_non_empty, staged
from .plausibility import is_saturated, saturation_warnings
from .progress import Progress
from .rig.camera import Window
from .scene import Scene

if TYPE_CHECKING:
    from .rendering.frame import RenderJob
    from .rendering.renderer import RenderedWindow, Renderer

# Of one image: a day's work of a fast processor.
MAX_SAMPLES = 10**12


@dataclass(frozen=True, slots=True, eq=False)
class WindowImage:
    """One rendered window of the sensor.

    `row` is the observation it shows; `window` is (x0, y0, width, height) in full-sensor pixels; `dn` (h, w) the
    sensor's counts; `irradiance` (h, w) before its noise and quantisation; `mask` (h, w) the part seen at each
    pixel's centre. `eye` moves by x_world = M x + t; `rendered` is all that the renderer gave.
    """

    name: str
    row: int
    camera: int
    window: Window
    dn: NDArray[Any]
    irradiance: Singles
    mask: Bytes
    labels: dict[str, Any]
    eye: EyeModel
    M: Floats
    t: Floats
    rendered: RenderedWindow


def render_windows(
    scene: Scene,
    observations: Observations,
    *,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    renderer: Renderer | None = None,
    progress: Progress | None = None,
) -> Iterator[WindowImage]:
    """Render every window of a scene, in frame order, at the poses of its analytic observations.

    A `renderer` made before is used again (see `make_renderer`), else one is made for `backend` and `threads`.

    Raises:
        BackendError: no backend renders; the message says how to fix it.
    """
    check_windows(scene)
    if renderer is None:
        renderer = make_renderer(backend, threads)
    index = observations.index
    eyes: dict[str, EyeModel] = {side: scene.eye(side) for side in scene.spec.subject.eyes}
    for row in range(len(observations)):
        side, camera = EYES[index.eye[row]], int(index.camera[row])
        job = render_job(scene, observations, row, eyes[side])
        done = renderer.render(job, spp=scene.spec.image.spp, moments=moments(scene, observations, row, job))
        labels = done.labels
        assert labels is not None
        yield WindowImage(
            f"{index.frame[row]:06d}_{side}",
            row,
            camera,
            done.window,
            _stored(scene, done.dn),
            done.irradiance,
            labels.part,
            {
                "pupil_visible_fraction": _share(labels.visible_fraction(3)),
                "iris_visible_fraction": _share(labels.visible_fraction(2)),
                "failed_paths": done.failed_paths,
                **_visibility(observations, row, done),
            },
            eyes[side],
            job.M,
            job.t,
            done,
        )
        if progress is not None:
            progress(row + 1, len(observations), "")


def render_job(scene: Scene, observations: Observations, row: int, eye: EyeModel | None = None) -> RenderJob:
    """What the renderer is asked for one observation: the eye in its pose, the rig, the window, the seed."""
    from .rendering.frame import RenderJob

    index, windows = observations.index, scene.windows()
    side, camera, head = EYES[index.eye[row]], int(index.camera[row]), int(index.head[row])
    eye = scene.eye(side) if eye is None else eye
    M, t = eye_motion(eye, observations, row)
    apex = index.eye_position_mm[row] + index.head_mm[row]
    return RenderJob(
        eye=eye,
        M=M,
        t=t + apex,
        camera=scene.rig.cameras[camera],
        window=windows[camera, head, int(index.eye[row])],
        lights=scene.rig.lights,
        sensor=scene.spec.sensor,
        look=scene.spec.look,
        region=scene.region,
        lens=scene.spec.lens,
        ambient=scene.ambient,
        wavelength_nm=scene.spec.wavelength_nm,
        seed=image_seed(scene.spec.seed, int(index.frame[row]), int(index.eye[row])),
        apex_mm=apex,
    )


def moments(scene: Scene, observations: Observations, row: int, middle: RenderJob) -> tuple[RenderJob, ...]:
    """The same window at even moments of the exposure, the eye and the head moving; none where nothing moves."""
    motion = scene.spec.motion
    if motion is None:
        return ()
    out = []
    pose = observations.pose
    for k in range(motion.steps):
        time_s = ((k + 0.5) / motion.steps - 0.5) * scene.spec.sensor.exposure_ms * 1e-3
        azimuth = pose.azimuth_rad[row] + np.radians(motion.eye_deg_s[0]) * time_s
        elevation = pose.elevation_rad[row] + np.radians(motion.eye_deg_s[1]) * time_s
        M, t = rigid_motion(Poses.listing([azimuth], [elevation]), middle.eye)
        apex = middle.anchor_mm + np.array(motion.head_mm_s) * time_s
        seed = int(np.random.SeedSequence([middle.seed, k]).generate_state(1, np.uint64)[0])
        out.append(replace(middle, M=M[0], t=t[0] + apex, apex_mm=apex, seed=seed, labels=False))
    return tuple(out)


def check_windows(scene: Scene) -> None:
    """Raise `InputError` for a scene whose eyes cannot be rendered."""
    if scene.spec.image.window_px is None and len(scene.spec.subject.eyes) > 1:
        raise InputError("missing; both eyes are rendered in a window each", path="image.window_px")
    spp = scene.spec.image.spp
    for i, camera in enumerate(scene.rig.cameras):
        width, height = scene.spec.image.window_px or camera.resolution_px
        if width * height > MAX_PIXELS:
            what = "image.window_px" if scene.spec.image.window_px else f"rig.cameras.{i}.resolution_px"
            raise InputError(f"{width} x {height} pixels are too many to render; at most {MAX_PIXELS}", path=what)
        if width * height * spp > MAX_SAMPLES:
            raise InputError(
                f"{width} x {height} pixels with {spp} samples each are more than {MAX_SAMPLES:.0e} samples",
                path="image.spp",
            )


def make_renderer(backend: BackendChoice = "auto", threads: int | None = None) -> Renderer:
    """A renderer on a backend that works; raises `BackendError`, which says how to fix it, if there is none."""
    from .backends.choose import choose_backend

    chosen = choose_backend(backend, threads)
    # Only now: importing the renderer imports mitsuba, which must find its backend ready.
    from .rendering.renderer import Renderer

    return Renderer(chosen)


def image_seed(seed: int, frame: int, eye: int) -> int:
    """The seed of one image: a pure function of the scene's seed and of which image it is."""
    return int(np.random.SeedSequence([seed, frame, eye]).generate_state(1, np.uint64)[0])


def render_folder(
    scene: Scene,
    path: str | Path,
    *,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    overwrite: bool = False,
    exr: bool = False,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> dict[str, Any]:
    """Render a scene into a folder of labelled images (docs/formats.md); complete or not at all.

    `warn` hears of saturated images before the folder is put in place; if it raises, nothing is written. What can be
    said of the scene beforehand is in `Scene.warnings`.

    Returns:
        What was written: schema eyerender/render/1, path, number of images, warnings of both kinds.
    """
    warnings = scene.warnings()
    refuse_non_empty(path, overwrite)  # before the work, not after it
    truth = observe(scene)
    records = list(truth.records())
    lines: list[dict[str, Any]] = []
    saturated = 0
    spec = scene.spec
    with staged(path, overwrite=overwrite) as folder:
        (folder / "images").mkdir()
        (folder / "masks").mkdir()
        for image in render_windows(scene, truth, backend=backend, threads=threads, progress=progress):
            line: dict[str, Any] = {
                "file_name": f"images/{image.name}.png",
                "mask_file_name": f"masks/{image.name}.png",
                "window_px": dict(zip(("x0", "y0", "width", "height"), image.window, strict=True)),
                "bit_depth": spec.sensor.bit_depth,
                "records": [records[image.row]],
                "labels": image.labels,
                "parameters": {
                    "eye_model": scene.eye_spec.name,
                    "pupil_diameter_mm": scene.pupil_diameter_mm,
                    "wavelength_nm": spec.wavelength_nm,
                    "spp": spec.image.spp,
                    "seed": spec.seed,
                    "camera": image.camera,
                },
            }
            write_png(folder / line["file_name"], image.dn)
            write_png(folder / line["mask_file_name"], image.mask)
            if exr:
                from .rendering.exr import write_exr

                write_exr(folder / "images" / f"{image.name}.exr", image.irradiance)
            lines.append(line)
            saturated += is_saturated(image.dn, spec.sensor)
        found = saturation_warnings(saturated, len(lines), scene.source)
        if warn is not None:
            warn(found)
        statistics = {"images": len(lines), "images_saturated": saturated, "observations": len(truth)}
        write_dataset(folder, lines, spec=spec.to_mapping(), digest=scene.digest(), statistics=statistics)
    return {
        "schema": "eyerender/render/1",
        "path": str(path),
        "images": len(lines),
        "warnings": [warning.to_mapping() for warning in (*warnings, *found)],
    }


def noiseless(scene: Scene, image: WindowImage) -> NDArray[Any]:
    """A rendering of a scene exposed once more, without the sensor's noise: what `sensor.noise: false` gives."""
    from .rig.exposure import expose

    sensor = scene.spec.sensor.model_copy(update={"noise": False})
    return _stored(scene, expose(sensor, image.irradiance.astype(float), scene.spec.wavelength_nm, 0))


def _stored(scene: Scene, dn: NDArray[np.uint16]) -> NDArray[Any]:
    """Counts in the type that they are written with."""
    return dn.astype(np.uint8) if scene.spec.sensor.bit_depth == 8 else dn


def eye_motion(eye: EyeModel, observations: Observations, row: int) -> tuple[Floats, Floats]:
    """The pose of one observation as a rigid motion of the eye frame: M (3, 3), t (3,)."""
    pose = observations.pose
    M, t = rigid_motion(
        Poses(pose.azimuth_rad[row : row + 1], pose.elevation_rad[row : row + 1], pose.torsion_rad[row : row + 1]), eye
    )
    return M[0], t[0]


def _visibility(observations: Observations, row: int, done: RenderedWindow) -> dict[str, Any]:
    """What is seen of pupil and glints, and where the lids are; the same keys with and without an eye region."""
    from .rendering.occlusion import visible_arcs_deg
    from .rendering.renderer import PUPIL

    assert done.labels is not None
    points = observations.pupil.points_px[row]
    arcs = None
    if observations.pupil.ok[row] and len(points) > 2:
        arcs = visible_arcs_deg(done.labels.part, PUPIL, points, done.window[:2])
    return {
        "pupil_visible_arcs_deg": arcs,
        "glints": [
            {"light": i, "reason": reason, "visible_share": float(share)}
            for i, (reason, share) in enumerate(zip(done.glint_reasons, done.glints.share, strict=True))
        ],
        "lid_margins_px": done.lid_margins_px,
    }


def _share(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
