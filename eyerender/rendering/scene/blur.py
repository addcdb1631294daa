"""Defocus of a job: one kernel if everything is equally out of focus, otherwise one per depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...base.arrays import Floats, Reals, Singles
from ...region.mesh import RegionMesh
from ...rig import defocus, psf
from ...rig.camera import Window
from ..records.job import RenderJob

_GLOBE_MM = 13.5  # the globe and the cornea about the sclera's centre
_BESIDE = 0.25  # share of a window's size: objects in this border may blur into the window


@dataclass(frozen=True, slots=True)
class Blur:
    """Defocus of a job's image."""

    job: RenderJob
    subject_px: float  # diameter of the circle of confusion of the eye
    layered: bool  # whether the blur of other depths differs visibly
    reach: int  # number of pixels needed beyond the window's border

    @classmethod
    def of(cls, job: RenderJob, posed: RegionMesh | None) -> Blur:
        """Compute the blur of a job with its posed region, before rendering.

        Raises:
            InputError: the eye would be blurred over more than 400 px.
        """
        camera, sensor = job.camera, job.sensor
        depth = float(camera.depth(job.eye.stop.centre_mm @ job.M.T + job.t))
        if job.lens.focus_mm is None or depth <= 0:  # a head behind the camera
            return cls(job, 0.0, False, 0)
        subject = defocus.checked(float(defocus.confusion_px(job.lens, camera, sensor, depth)))
        depths = _depths(job, posed)
        sizes = defocus.confusion_px(job.lens, camera, sensor, depths)
        if np.min(depths) < job.lens.focus_mm < np.max(depths):
            sizes = np.append(sizes, 0.0)
        layered = not defocus.one_blur(sizes, subject, sensor.psf_sigma_px)
        reach = defocus.reach_px(float(np.max(sizes)) if layered else subject)
        return cls(job, subject, layered, reach)

    @property
    def border_px(self) -> int:
        """Width of the border around the job's window that lens and point-spread function need."""
        return self.reach + psf.margin(self.job.sensor.psf_sigma_px)

    @property
    def window(self) -> Window:
        """The job's window with this border."""
        (x0, y0, width, height), pad = self.job.window, self.border_px
        return x0 - pad, y0 - pad, width + 2 * pad, height + 2 * pad

    def of_pictures(self, pictures: Reals) -> Reals:
        """Blur an image; the result is smaller by the reach on every side.

        Args:
            pictures: (height, width) radiance; for a layered blur, its parts (`film.start`).
        """
        if not self.layered:
            return defocus.defocused(pictures, self.subject_px)
        job, layers = self.job, []
        for radiance, coverage, near in pictures:
            nearness = np.divide(near, coverage, out=np.zeros_like(near), where=coverage > 0)
            size = defocus.confusion_of(job.lens, job.camera, job.sensor, nearness)
            layers.append(defocus.Layer(radiance, coverage, size))
        return defocus.blurred(layers, self.reach)

    def of_reflections(self, picture: Singles) -> Reals:
        """Blur what worn lenses mirror (height, width), as much as the eye; the result is as that of `of_pictures`."""
        if not self.layered:
            return defocus.defocused(picture, self.subject_px)
        layer = defocus.Layer(picture, np.ones_like(picture), np.full_like(picture, self.subject_px))
        return defocus.blurred([layer], self.reach)

    def of_image(self, nearness: Floats) -> float:
        """Compute the circle of confusion (diameter, px) of a mirror image: rms over its inverse depths (1/mm)."""
        job = self.job
        if not np.all(np.isfinite(nearness)):
            return self.subject_px
        return float(np.sqrt(np.mean(defocus.confusion_of(job.lens, job.camera, job.sensor, nearness) ** 2)))


def _depths(job: RenderJob, posed: RegionMesh | None) -> Floats:
    """Compute the nearest and farthest depth (mm) of objects in the window."""
    camera = job.camera
    middle = float(camera.depth(np.asarray(job.eye.sclera.centre_mm) @ job.M.T + job.t))
    depths = [middle - _GLOBE_MM, middle]
    if posed is not None or job.obstacles:
        bodies = [body.vertices for body in job.obstacles]
        points = posed.vertices + job.anchor_mm if posed is not None else np.concatenate(bodies)
        xy, front = camera.project(points)
        x0, y0, width, height = job.window
        with np.errstate(invalid="ignore"):
            seen = front & (np.abs((xy - (x0 - 0.5, y0 - 0.5)) / (width, height) - 0.5) < 0.5 + _BESIDE).all(axis=1)
        z = camera.depth(points[seen])
        depths += [float(z.min()), float(z.max())] if len(z) else []
    return np.array([min(depths), max(depths)])
