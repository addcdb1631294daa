"""Observe a scene with one cause of error after the other, for the error budget of gaze (`gaze/budget.py`).

    estimator        exact features of the reference eye; the pupil is the image of the stop's centre
    eye model        the same for the scene's own eye
    optics           the centre of the apparent pupil's ellipse: refraction and perspective of its outline
    extraction       features extracted from an ideal image: bare eye, lamps only, ideal lens, no noise
    image formation  features extracted from the scene's image without noise: lids, lashes, blur, motion, ...
    noise            features extracted from the same image with noise, once for each seed

If the scene's image without noise is already ideal, extraction and image formation are one step, `image`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..analytic.observer import trace
from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..base.progress import COMPILING, Progress, notify
from ..gaze.budget import ESTIMATOR
from ..rig.exposure import recorded
from ..rig.imaging import Ambient, Lens
from ..rig.sensor import Sensor
from ..scene import Frames, Scene
from ..scene.observation import Observations, concatenate
from .capture import EyeImage, make_renderer, render_windows, stored
from .imageobserver import ImageObserver

if TYPE_CHECKING:
    from ..rendering.renderer import Renderer

REFERENCE = "E1"
SEEDS = 10


def budget_steps(
    frames: Frames,
    *,
    reference: str = REFERENCE,
    images: bool = True,
    seeds: int = SEEDS,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> dict[str, list[Observations]]:
    """Observe the frames of a scene with one cause of error after the other; the input of `er.gaze.budget`.

    Every image is rendered once and exposed again for each seed.

    >>> steps = er.budget_steps(er.load_scene("guestrin2006").frames(), images=False)
    >>> list(steps)
    ['estimator', 'eye model', 'optics']

    Args:
        frames: frames with targets.
        reference: eye model with whose features the estimator's own error is computed.
        images: whether to render images; without them the steps end with `optics`.
        seeds: number of exposures of each image with other noise.
        backend: backend that renders.
        threads: number of processor threads for rendering; None: all.
        progress: called with (images done, images in all, note).

    Raises:
        InputError: the frames have no targets or are those of a sequence, or seeds < 1.
        BackendError: no backend can render.
    """
    if seeds < 1:
        raise InputError(f"must be >= 1, not {seeds}", path="seeds")
    if frames.scene.spec.sequence is not None:
        raise InputError("has no fixations to calibrate on; a budget needs a scene with targets", path="sequence")
    if not np.isfinite(frames.index.target_mm).all():
        raise InputError("there are no targets to compare the gaze with; use a scene with targets")
    exact = trace(frames)
    simple = _with_eye(frames, reference)
    steps = {ESTIMATOR: [with_stop_centre(trace(simple))], "eye model": [with_stop_centre(exact)], "optics": [exact]}
    if not images:
        return steps
    steps.update(_image_steps(frames, seeds, make_renderer(backend, threads), progress))
    return steps


def _image_steps(
    frames: Frames, seeds: int, renderer: Renderer, progress: Progress | None
) -> dict[str, list[Observations]]:
    """Observe the steps that need images; each image is exposed, observed and dropped before the next."""
    observer, sensor = ImageObserver(), frames.scene.spec.sensor
    ideal, own = ideal_scene(frames.scene), without_noise(frames.scene)
    apart = ideal.spec != own.spec
    rows: dict[tuple[str, int], list[Observations]] = {}

    def note(cause: str, seed: int, image: EyeImage) -> None:
        rows.setdefault((cause, seed), []).append(observer.observe_images([image]))

    scenes = ([(ideal, "extraction")] if apart else []) + [(own, "image formation" if apart else "image")]
    notify(progress, 0, len(scenes) * len(frames), COMPILING)
    for k, (scene, cause) in enumerate(scenes):
        images = render_windows(frames.of_scene(scene), renderer=renderer)
        for done, image in enumerate(images, 1):
            note(cause, 0, image)
            for seed in range(seeds) if scene is own and sensor.noise else ():
                note("noise", seed, exposed_again(image, scene, sensor, seed))
            notify(progress, k * len(frames) + done, len(scenes) * len(frames), "images")
    steps: dict[str, list[Observations]] = {}
    for (cause, _), seen in rows.items():
        steps.setdefault(cause, []).append(concatenate(seen))
    return steps


def with_stop_centre(observations: Observations) -> Observations:
    """Replace the centres of the pupils by the images of the stops' centres."""
    pupil = observations.pupil
    return replace(observations, pupil=replace(pupil, centre_px=pupil.anatomical_centre_px))


def ideal_scene(scene: Scene) -> Scene:
    """Replace the scene's camera by an ideal one, and use bare eyes and lamps only."""
    spec, own = scene.spec, scene.spec.sensor
    sensor = own.model_copy(
        update={
            "noise": False, "bit_depth": 16, "gamma": 1.0, "jpeg_quality": None, "blooming": 0.0, "sharpening": 0.0,
            "border_px": (0, 0, 0, 0), "border_dn": 0.0,
            "black_level_dn": None, "gain_dn_per_e": None,
        }
    )  # fmt: skip
    changes = {"region": None, "lens": Lens(), "motion": None, "ambient": Ambient(), "sensor": sensor}
    return scene.replaced(spec.model_copy(update=changes))


def exposed_again(image: EyeImage, scene: Scene, sensor: Sensor, seed: int) -> EyeImage:
    """Expose a scene's rendered image with another sensor and other noise; the sensor's fixed pattern stays."""
    spec, index = scene.spec, image.frame.index
    scene = scene.replaced(spec.model_copy(update={"sensor": sensor}))
    camera = scene.rig.cameras[image.camera]
    draw = np.random.SeedSequence([spec.seed, int(index.frame[0]), int(index.eye[0]), seed])
    dn = recorded(
        sensor, camera, image.window, image.irradiance.astype(float), spec.wavelength_nm,
        int(draw.generate_state(1, np.uint64)[0]),
    )  # fmt: skip
    return replace(image, frame=image.frame.of_scene(scene), counts=stored(scene, dn))


def without_noise(scene: Scene) -> Scene:
    """Replace the sensor of a scene by one without noise."""
    sensor = scene.spec.sensor.model_copy(update={"noise": False})
    return scene.replaced(scene.spec.model_copy(update={"sensor": sensor}))


def _with_eye(frames: Frames, model: str) -> Frames:
    """Let eyes of another model fixate the same targets, with the scene's pupil diameter if it sets one."""
    scene = frames.scene
    other = Scene.of(scene.spec, base=scene.base, eye=model, source=scene.source)
    found = other.frames()
    keys = ("frame", "fixation", "camera", "eye")
    if len(found) != len(frames):
        where = {tuple(int(getattr(found.index, k)[i]) for k in keys): i for i in range(len(found))}
        rows = [where[tuple(int(getattr(frames.index, k)[i]) for k in keys)] for i in range(len(frames))]
        found = found.take(np.array(rows))
    return found
