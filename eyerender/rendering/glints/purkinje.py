"""Purkinje images 2 to 4: lamps mirrored by the back of the cornea, the lens' front and its back, with their energy.

The solver of `optics` finds the path from the camera's nodal point through the surfaces, to the mirror and out to the
lamp. This module computes its energy. With T the product of 1 - F at every refraction and F at the mirror, and J the
ray tube's cross section at the lamp per solid angle at the camera (equal to the reverse, both being in air):

    e = I(d) T f_x f_y D / (J cos^3(theta))        as for the first image (`glints`)

Images 3 and 4 pass the pupil twice, and exist only where both passages are inside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.errors import InputError
from ...base.status import Status
from ...eye.model import EyeModel
from ...optics.gradient import GradientMedium
from ...optics.interface import fresnel
from ...optics.purkinje import purkinje_path, purkinje_points
from ...optics.shooting import ray_tube
from ...optics.surfaces import Surface, components, join
from ...optics.trace import Crossing, Traced, trace
from ...rig.light import Lamp
from .cutdiscs import Nodes
from .tracing import Emitters, GlintScene, Image, LightPaths


def purkinje_images(
    scene: GlintScene, eye: EyeModel, order: int, lights: Sequence[Lamp], nodes: Sequence[Nodes]
) -> list[Image]:
    """Compute the mirror images of order `order` of the lamps, through given points of their discs."""
    surfaces, indices, rims, passing, gradient = stack(eye, order)
    path = purkinje_path(surfaces, indices, rims, passing, gradient)
    emitters, eyepoint = Emitters.of(lights, nodes), scene.eyepoint
    sources = (emitters.points - scene.t) @ scene.M
    points = purkinje_points(surfaces, indices, rims, passing, sources, eyepoint, gradient)
    ok = np.asarray(points.status) == Status.OK
    out = np.where(ok[:, None], -np.asarray(points.directions), np.array([-1.0, 0.0, 0.0]))
    traced = trace(path, 1.0, np.broadcast_to(eyepoint, out.shape), out)
    ok &= np.asarray(traced.status) == Status.OK
    if order > 2:
        ok &= _through_pupil(eye, traced.points_mm, len(eye.front))
    rays = ray_tube(path, 1.0, components(eyepoint), components(out), components(sources))
    return scene.pictured(
        emitters,
        LightPaths(
            entry=traced.points_mm[-1], exit=traced.points_mm[1], arrives=-join(rays.end), leaves=-out,
            passed=transmittance(path, traced, indices[-1], scene.film_index), cross_section=rays.cross_section_mm2_sr,
            found=ok, there=ok,
        ),
    )  # fmt: skip


def transmittance(path: Sequence[Crossing], traced: Traced, behind: float, film: float) -> Floats:
    """Compute the transmittance of paths: F at the mirror, times 1 - F at every other surface on the path.

    `behind` is the index behind the mirror, `film` that of the film on the first surface, which is crossed twice.
    """
    share = np.ones(traced.points_mm.shape[1])
    index = np.ones_like(share)
    for k, crossing in enumerate(path):
        y, before = traced.points_mm[k + 1], traced.directions[k]
        cosine = np.abs(np.einsum("ij,ij->i", crossing.surface.normal(y), before))
        if crossing.reflects:
            share *= np.asarray(fresnel(cosine, index, behind).unpolarized)
            continue
        # A ray misses the shells of a gradient lens that do not extend to it.
        met = np.any(traced.directions[k + 1] != before, axis=1)
        after = float(np.asarray(crossing.n_after))
        on_air = film if k in (0, len(path) - 1) else None
        share *= np.where(met, 1 - np.asarray(fresnel(cosine, index, after, on_air).unpolarized), 1.0)
        index = np.where(met, after, index)
    return share


def _through_pupil(eye: EyeModel, points: Floats, corneal: int) -> Bools:
    """Return whether rays cross the plane of the stop inside the pupil, both inwards and outwards."""
    n, c = eye.stop.normal, eye.stop.centre_mm
    inside = np.ones(points.shape[1], dtype=bool)
    for a, b in ((points[corneal], points[corneal + 1]), (points[-corneal - 1], points[-corneal - 2])):
        step = (c - a) @ n / ((b - a) @ n)
        inside &= eye.stop.contains(a + step[:, None] * (b - a))
    return inside


def stack(
    eye: EyeModel, order: int
) -> tuple[tuple[Surface, ...], tuple[float, ...], tuple[float, ...], tuple[bool, ...], GradientMedium | None]:
    """Return the surfaces down to the mirror, with everything needed to trace a ray through them.

    Returns the surfaces, the indices behind them, their rims, whether a ray may miss them, and the gradient in front of
    the mirror. Raises InputError if the eye has no such image.
    """
    if order not in eye.purkinje_orders or order == 1:
        raise InputError(f"{eye.name} has no Purkinje image {order}", path="purkinje")
    corneal = len(eye.front)
    depth = {2: corneal, 3: corneal + 1, 4: corneal + len(eye.back)}[order]
    rims = (float(eye.limbus_radius_mm), *(np.inf for _ in eye.front[1:]), *(float(r) for r in eye.back_rims_mm))
    indices = tuple(float(n) for n in (*eye.front_indices, *eye.back_indices))
    passing = ((False,) * corneal + eye.back_passing)[:depth]
    gradient = eye.lens_gradient if order == 4 else None
    return (eye.front + eye.back)[:depth], indices[:depth], rims[:depth], passing, gradient
