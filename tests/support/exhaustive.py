"""An exhaustive search for refracted rays, from the object's side.

It shares only single traces with the solver: it launches a dense cone of rays outward from the object and improves
those that leave closest to the viewpoint by damped Newton with differences.
"""

from __future__ import annotations

import numpy as np

from eyerender.base.status import Status
from eyerender.optics.trace import inward_path, outward_path, trace

WIDTH_MM = 6.6
"""Out to here the surfaces must not meet each other; exits beyond are not asked for."""


def launch(at):
    """Directions about +x; `at` (m, 2) is the angle from it, as a vector."""
    angle = np.linalg.norm(at, axis=-1)
    return np.concatenate([np.cos(angle)[:, None], at * np.sinc(angle / np.pi)[:, None]], axis=-1)


def misses(surfaces, indices, at, things, places):
    """By how much rays launched from things (m, 3) pass places (m, 3), as sines (m, 2), and exit points (m, 3)."""
    out = trace(outward_path(surfaces, indices), indices[-1], things, launch(at))
    gap = places - out.points_mm[-1]
    gap = gap / np.linalg.norm(gap, axis=-1, keepdims=True)
    first = np.cross(gap, np.eye(3)[np.argmin(np.abs(places), axis=-1)])
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    way = out.directions[-1]
    off = np.stack([np.sum(way * first, axis=-1), np.sum(way * np.cross(gap, first), axis=-1)], axis=-1)
    ok = (out.status == Status.OK) & (np.sum(way * gap, axis=-1) > 0.0)
    return np.where(ok[:, None], off, np.nan), out.points_mm[-1]


def size_of(off):
    return np.nan_to_num(np.linalg.norm(off, axis=-1), nan=np.inf)


def exhaustive(surfaces, indices, things, places, grid=61, tries=6, halvings=25):
    """The exit points of rays that join things and places (m, 3); NaN where none is found."""
    axis = np.linspace(-1.6, 1.6, grid)
    cone = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    start = []
    for thing, place in zip(things, places, strict=True):
        whole = np.broadcast_to(thing, (len(cone), 3)), np.broadcast_to(place, (len(cone), 3))
        start.append(cone[np.argsort(size_of(misses(surfaces, indices, cone, *whole)[0]))[:tries]])
    at = np.concatenate(start)
    things, places = np.repeat(things, tries, axis=0), np.repeat(places, tries, axis=0)

    def several(points):
        """Misses of points (j, m, 2): (j, m, 2)."""
        j = len(points)
        off, _ = misses(surfaces, indices, points.reshape(-1, 2), np.tile(things, (j, 1)), np.tile(places, (j, 1)))
        return off.reshape(points.shape)

    h = 1e-7
    for _ in range(40):
        nudged = at + np.concatenate([np.zeros((1, 1, 2)), h * np.eye(2)[:, None], -h * np.eye(2)[:, None]])
        here, *beside = several(nudged)
        columns = []
        for ahead, behind in zip(beside[:2], beside[2:], strict=True):
            # On the rim of total reflection only one side has a ray.
            sides = 2.0 - np.isnan(ahead[:, :1]) - np.isnan(behind[:, :1])
            rise = np.where(np.isnan(ahead), here, ahead) - np.where(np.isnan(behind), here, behind)
            columns.append(rise / (h * np.maximum(sides, 1.0)))
        slope = np.nan_to_num(np.stack(columns, axis=-1))
        slope = np.where((np.abs(np.linalg.det(slope)) > 1e-14)[:, None, None], slope, np.eye(2))
        step = -np.linalg.solve(slope, np.nan_to_num(here)[..., None])[..., 0]
        step /= np.maximum(np.linalg.norm(step, axis=-1, keepdims=True) / 0.2, 1.0)
        tried = at + 0.5 ** np.arange(halvings)[:, None, None] * step
        new = size_of(several(tried))
        best = np.argmin(new, axis=0)
        better = np.min(new, axis=0) < size_of(here)
        if not better.any():
            break
        at = np.where(better[:, None], tried[best, np.arange(len(at))], at)
    off, points = misses(surfaces, indices, at, things, places)
    # The ray must be one on the way in, too: a sheet is crossed from its front.
    way = points - places
    back = trace(inward_path(surfaces, indices), 1.0, places, way / np.linalg.norm(way, axis=-1, keepdims=True))
    good = (size_of(off) < 1e-11) & (back.status == Status.OK)
    good &= np.sum((things - back.points_mm[-1]) * back.directions[-1], axis=-1) > 0.0
    good &= np.hypot(points[:, 1], points[:, 2]) < WIDTH_MM
    points = np.where(good[:, None], points, np.nan).reshape(-1, tries, 3)
    first = np.argmax(good.reshape(-1, tries), axis=1)
    return points[np.arange(len(points)), first]
