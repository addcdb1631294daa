"""Observing a study's scenes: by ray optics, or in images that are rendered into folders and used again.

A camera that does not see an eye is turned about its nodal point until it faces it. That changes no ray: the features
it gives are brought back to the study's own camera along their rays,

    x_cam = R R_turned^T ray,    pixel = K x_cam / z

so that estimators and rig stay as they are. (The centre of an ellipse is not quite the image of a centre, in either
camera.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..analytic.observer import observe
from ..arrays import Floats, frozen
from ..errors import InputError
from ..imagefolder import ImageFolder, same_run
from ..observation import EYES, Observations, concatenate
from ..rig.camera import Camera
from ..scene import Scene, SceneSpec

Kind = Literal["analytic", "image", "image-noiseless"]
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class ImageSettings:
    """How images are made: their folder, samples per pixel, and where to render.

    With `paired` each rendering is exposed with and without the sensor's noise, so that the second costs no rendering.
    """

    folder: Path
    spp: int | None = None
    paired: bool = False
    backend: Literal["auto", "cuda", "llvm"] = "auto"
    threads: int | None = None
    progress: Progress | None = None


@dataclass(frozen=True, slots=True)
class Observing:
    """One of the observers, ready for a study's scenes: ray optics, or images with the sensor's noise or without it.

    Image settings are needed for images alone.
    """

    kind: Kind = "analytic"
    images: ImageSettings | None = None

    def observe(self, scene: Scene, name: str, *, facing: bool = False) -> Observations:
        """Every (frame, eye) of a scene. `name` is its folder of images; with `facing` the cameras are turned to the
        eyes.

        Raises:
            InputError: a target that no pose of an eye fixates, or a folder that holds something else.
            BackendError: there is nothing to render with.
        """
        if self.kind == "analytic":
            return observe(scene)
        if self.images is None:
            raise InputError("the image observer needs a folder for its images")
        noise = self.kind == "image"
        if not facing:
            return self._images(scene, name, self.images, noise)
        parts, order = [], []
        index = scene.frames().index
        for head, place in enumerate(scene.spec.subject.head_positions_mm):
            for side in scene.spec.subject.eyes:
                rows = np.flatnonzero((index.head == head) & (index.eye == EYES.index(side)))
                turned = facing_scene(scene, place, side)
                seen = self._images(turned, f"{name}-h{head}-{side}", self.images, noise)
                parts.append(with_index_of(moved(seen, turned.rig.cameras[0], scene.rig.cameras[0]), scene, rows))
                order.append(rows)
        return concatenate(parts).take(np.argsort(np.concatenate(order)))

    @staticmethod
    def _images(scene: Scene, name: str, settings: ImageSettings, noise: bool) -> Observations:
        """Features of a scene's images, which are rendered unless the folder holds them already."""
        from ..capture import render_folder, without_noise
        from ..observers import ImageObserver

        data = scene.spec.to_mapping()
        if settings.spp is not None:
            data["image"]["spp"] = settings.spp
        noisy = replace(scene, spec=SceneSpec.from_mapping(data))
        scene = noisy if noise else without_noise(noisy)
        folders = {True: settings.folder / name, False: settings.folder / f"{name}-noiseless"}
        path = folders[noise]
        progress = settings.progress

        def show(what: str) -> Progress | None:
            return None if progress is None else lambda done, total, _note: progress(done, total, f"{what} {name}")

        if not same_run(path, scene.digest()):
            render_folder(
                scene,
                path,
                backend=settings.backend,
                threads=settings.threads,
                # What lies there is a run of other settings of this very study, whose folder this is.
                overwrite=True,
                noiseless=folders[False] if noise and settings.paired else None,
                progress=show("rendering"),
            )
        return ImageObserver().observe_folder(ImageFolder.load(path), scene, progress=show("extracting"))


def facing_scene(scene: Scene, head_mm: tuple[float, float, float], side: str) -> Scene:
    """The scene of one head position and one eye, with every camera turned about its nodal point to face that eye."""
    data = scene.spec.to_mapping()
    apex = scene.eye_position_mm(side) + np.array(head_mm)
    data["subject"]["eyes"] = [side]
    data["subject"]["head_positions_mm"] = [list(head_mm)]
    for camera in data["rig"]["cameras"]:
        if camera.get("calibration"):
            raise InputError("a calibrated camera cannot be turned", path="rig.cameras")
        for key in ("pan_deg", "tilt_deg"):
            camera.pop(key, None)
        camera["look_at_mm"] = [float(v) for v in apex]
    spec = SceneSpec.from_mapping(data)
    return replace(scene, spec=spec, rig=spec.rig.build())


def moved(observations: Observations, seen_by: Camera, told: Camera) -> Observations:
    """Pupil centres and glints as another camera with the same nodal point has them; ellipses' axes are left out."""

    def pixels(places: Floats) -> Floats:
        cam = seen_by.rays(places) @ told.R.T
        front = cam[..., 2] > 0
        z = np.where(front, cam[..., 2], np.nan)
        return told.pixels_of(cam[..., 0] / z, cam[..., 1] / z)

    pupil, glints = observations.pupil, observations.glints
    n = len(observations)
    centre, spots = pixels(pupil.centre_px), pixels(glints.xy_px)
    return replace(
        observations,
        pupil=replace(
            pupil,
            centre_px=frozen(centre),
            in_image=frozen(told.in_image(centre), bool),
            semi_axes_px=frozen(np.full((n, 2), np.nan)),
            angle_rad=frozen(np.full(n, np.nan)),
            points_px=frozen(np.full((n, 0, 2), np.nan)),
            covariance=frozen(np.full((n, 5, 5), np.nan)),
        ),
        glints=replace(
            glints,
            xy_px=frozen(spots),
            in_image=frozen(told.in_image(spots), bool),
            covariance=frozen(np.full((*spots.shape, 2), np.nan)),
        ),
    )


def with_index_of(observations: Observations, scene: Scene, rows: np.ndarray) -> Observations:
    """The observations as rows of a scene's own index."""
    index = scene.frames().index
    part = replace(index, **{f.name: frozen(v := getattr(index, f.name)[rows], v.dtype) for f in fields(index)})
    return replace(observations, index=part)
