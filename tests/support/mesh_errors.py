"""Errors of a picture rendered with a meshed cornea, against the same picture with exact surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_erosion

from eyerender.rendering.records.job import RenderJob
from eyerender.rendering.renderer import Renderer
from eyerender.scene.parts import IRIS
from tests.support.render_oracles import contour_shift, outline
from tests.support.render_rigs import PLAIN, RIGS, eye_of, job_of

_POSE = (6.0, -4.0)


@dataclass(frozen=True)
class MeshErrors:
    """Largest errors: places of glints (px), their energies (relative), outlines (px rms), iris radiance (relative).

    `pupil_px` is the outline of the pupil, `limbus_px` that of the cornea, `iris` the difference of the mean radiance,
    `iris_rms` the rms of the difference between pixels, `failed` the number of light paths that were not found.
    """

    glint_px: float
    glint_energy: float
    pupil_px: float
    limbus_px: float
    iris: float
    iris_rms: float
    failed: int


def mesh_job(model: str, rig_name: str) -> RenderJob:
    """The job that is compared: an even eye, turned a little, before a remote or a head-mounted camera."""
    rig = RIGS[rig_name]()
    window = rig.window(160, 120) if rig_name == "remote" else rig.window(400, 300)
    return job_of(eye_of(model), rig, window, _POSE, look=PLAIN)


def mesh_errors(renderer: Renderer, job: RenderJob, edge_mm: float, spp: int) -> MeshErrors:
    """Compare a job with itself, rendered with a mesh of a given length of edges."""
    rough = replace(job, mesh_edge_mm=edge_mm)
    exact, mesh = renderer.render(job, spp=spp), renderer.render(rough, spp=spp)
    assert exact.labels is not None
    assert mesh.labels is not None
    away = np.linalg.norm(mesh.glints.xy_px - exact.glints.xy_px, axis=1)
    iris = binary_erosion((exact.labels.part == IRIS) & (mesh.labels.part == IRIS), iterations=4)
    there = exact.irradiance[iris].astype(float)
    plain = there < 1.5 * np.median(there)  # no glint
    ratio = mesh.irradiance[iris][plain] / there[plain] - 1
    return MeshErrors(
        glint_px=float(away.max()),
        glint_energy=float(np.abs(mesh.glints.energy / exact.glints.energy - 1).max()),
        pupil_px=_outline_px(renderer, job, edge_mm, spp),
        limbus_px=_limbus_px(renderer, job, edge_mm, spp),
        iris=float(abs(ratio.mean())),
        iris_rms=float(ratio.std()),
        failed=mesh.failed_paths,
    )


def _outline_px(renderer: Renderer, job: RenderJob, edge_mm: float, spp: int) -> float:
    """Distance of the pupil's outlines: the quotient of a black and a grey pupil is the iris' share of each pixel."""
    polygon = outline(job)
    shares = []
    for edge in (None, edge_mm):
        dark, grey = (
            renderer.radiance(
                replace(job, mesh_edge_mm=edge, look=PLAIN.model_copy(update={"pupil_albedo": albedo})), spp=spp
            )
            for albedo in (0.0, PLAIN.iris_albedo)
        )
        shares.append(1 - dark / grey)
    return contour_shift(shares[1] - shares[0], polygon, job.window)


def _limbus_px(renderer: Renderer, job: RenderJob, edge_mm: float, spp: int) -> float:
    """Distance of the limbus' outlines, from a black inside of the eye in a bright sclera."""
    eye = job.eye
    look = PLAIN.model_copy(
        update={"pupil_albedo": 0.0, "iris_albedo": 0.0, "limbus_albedo": 0.0, "limbus_width_mm": 0.0}
    )
    turn = 2 * np.pi * np.arange(720) / 720
    rim = float(eye.limbus_radius_mm) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points = eye.front[0].to_eye(np.column_stack([eye.front[0].sag(*rim.T), rim]))
    polygon = job.camera.project(points @ job.M.T + job.t)[0]
    dark = [renderer.radiance(replace(job, mesh_edge_mm=edge, look=look), spp=spp) for edge in (None, edge_mm)]
    level = np.median(dark[0][dark[0] > 0.5 * dark[0].max()])
    return contour_shift(-(dark[1] - dark[0]) / level, polygon, job.window)
