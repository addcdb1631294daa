"""Observe a study's scenes by ray optics, or in the images of a dataset (see `images`).

A camera that does not see an eye is turned about its nodal point until it faces it. This changes no ray. Its features
are transferred to the study's camera along their rays,

    x_cam = R R_turned^T ray,    pixel = K x_cam / z

so that estimators and rig do not change. An ellipse is transferred by its outline, because its centre is not the image
of a centre. For a camera without distortion it becomes another ellipse exactly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from ...analytic.observer import trace
from ...backends.choose import BackendChoice
from ...base.arrays import Floats, Ints, frozen
from ...imaging.capture import EyeImage, make_renderer, render_windows
from ...imaging.imageobserver import ImageObserver
from ...optics.ellipse import fit_ellipse_direct, points_on_ellipse
from ...rig.camera import PinholeCamera
from ...scene import Scene
from ...scene.observation import Observations, concatenate
from .images import EyeShot, StudyImages, shots

if TYPE_CHECKING:
    from ...rendering.renderer import Renderer

OUTLINE_POINTS = 64
ObserverKind = Literal["analytic", "image", "image-noiseless"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Observing:
    """Observer of a study's scenes: ray optics, or images with or without the sensor's noise.

    Images without noise may be exposed again with the noise of `noise_seed`; `noise_seeds` is the number of such
    exposures that a study compares. Without a dataset of `images`, as for people, they are rendered (`spp`, `backend`,
    `threads`), extracted and dropped.
    """

    kind: ObserverKind = "analytic"
    images: StudyImages | None = None
    noise_seeds: int = 0
    noise_seed: int | None = None
    spp: int | None = None
    backend: BackendChoice = "auto"
    threads: int | None = None

    def exposures(self) -> list[Observing]:
        """Return observers of the same images, exposed again with the noise of one seed each."""
        return [replace(self, noise_seed=seed) for seed in range(self.noise_seeds)]

    def observe(self, scene: Scene, *, facing: bool = False) -> Observations:
        """Observe every (frame, eye) of a scene; with `facing`, the cameras are turned to the eyes.

        Raises:
            InputError: no pose of an eye fixates a target, or images do not exist.
            BackendError: no backend renders.
        """
        if self.kind == "analytic":
            return trace(scene)
        parts, order = [], []
        for shot in self.shots(scene, facing=facing, spp=self.spp if self.images is None else self.images.spp):
            if self.images is None:
                seen = extracted(self.images_of(shot.scene))
            else:
                seen = self.images.observe(shot.scene, self.noise_seed)
            if facing:
                seen = moved(seen, shot.scene.rig.cameras[0], scene.rig.cameras[0])
            parts.append(with_index_of(seen, scene, shot.rows))
            order.append(shot.rows)
        return concatenate(parts).take(np.argsort(np.concatenate(order)))

    def images_of(self, scene: Scene) -> Iterator[EyeImage]:
        """Render all frames of a scene, without storing them."""
        return render_windows(scene.frames(), renderer=_renderer(self.backend, self.threads))

    def shots(self, scene: Scene, *, facing: bool = False, spp: int | None = None) -> list[EyeShot]:
        """Return the shots that this observer needs of a scene; none for ray optics."""
        return [] if self.kind == "analytic" else shots(scene, noise=self.kind == "image", facing=facing, spp=spp)


@cache
def _renderer(backend: BackendChoice, threads: int | None) -> Renderer:
    return make_renderer(backend, threads)


def extracted(images: Iterable[EyeImage]) -> Observations:
    """Extract the features of rendered images."""
    return ImageObserver().observe_images(images)


def moved(observations: Observations, seen_by: PinholeCamera, told: PinholeCamera) -> Observations:
    """Transfer pupil ellipses and glints to another camera with the same nodal point; covariances are dropped."""

    def pixels(places: Floats) -> Floats:
        x, y, _ = told.plane(seen_by.rays(places) @ told.R.T)
        return told.pixels_of(x, y)

    pupil, glints = observations.pupil, observations.glints
    n = len(observations)
    outline = points_on_ellipse(pupil.centre_px, pupil.semi_axes_px, pupil.angle_rad, OUTLINE_POINTS)
    ellipse = fit_ellipse_direct(pixels(outline))
    centre, spots = ellipse.centre_px, pixels(glints.xy_px)
    return replace(
        observations,
        pupil=replace(
            pupil,
            centre_px=frozen(centre),
            in_image=frozen(told.in_image(centre), bool),
            semi_axes_px=frozen(ellipse.semi_axes_px),
            angle_rad=frozen(ellipse.angle_rad),
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


def with_index_of(observations: Observations, scene: Scene, rows: Ints) -> Observations:
    """Attach rows of a scene's index to observations."""
    return replace(observations, index=scene.index().take(rows))
