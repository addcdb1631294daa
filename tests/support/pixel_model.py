"""The pixel model of a pupil's boundary, written with NumPy from its formula, as an oracle for the compiled one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import erf, ndtr

from eyerender.base.arrays import Floats
from eyerender.extraction.pupil.edge_model import EdgeModel
from eyerender.optics.ellipse import Ellipse


@dataclass(frozen=True, slots=True)
class Nearest:
    """Nearest points (n,) of an ellipse: signed distance, parameter t, outward normals (n, 2) and curvature."""

    distance: Floats
    t: Floats
    normal: Floats
    curvature: Floats


def nearest(ellipse: Ellipse, x: Floats, y: Floats) -> Nearest:
    """Find the nearest points of an ellipse by bisection in the first quadrant of its own axes.

    There, f(t) = (a^2 - b^2) cos t sin t - a p sin t + b q cos t falls from b q to -a p, for a point (p, q).
    """
    a, b = ellipse.semi_axes_px.tolist()
    cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
    dx, dy = x - ellipse.centre_px[0], y - ellipse.centre_px[1]
    p, q = dx * cos + dy * sin, dy * cos - dx * sin
    low, high = np.zeros_like(p), np.full_like(p, 0.5 * np.pi)
    for _ in range(60):
        t = 0.5 * (low + high)
        before = (a * a - b * b) * np.cos(t) * np.sin(t) - a * np.abs(p) * np.sin(t) + b * np.abs(q) * np.cos(t) > 0.0
        low, high = np.where(before, t, low), np.where(before, high, t)
    t = np.arctan2(np.sin(t) * np.sign(q), np.cos(t) * np.sign(p))
    nx, ny = b * np.cos(t), a * np.sin(t)
    height = np.hypot(nx, ny)
    nx, ny = nx / height, ny / height
    distance = (p - a * np.cos(t)) * nx + (q - b * np.sin(t)) * ny
    normal = np.stack([nx * cos - ny * sin, nx * sin + ny * cos], axis=-1)
    return Nearest(distance, t, normal, a * b / height**3)


def level(model: EdgeModel, x: Floats, y: Floats) -> Floats:
    """Grey level (n,) of an exact ellipse's model, by the formulas at the top of `edge_model`."""
    at, sigma, outer = nearest(model.ellipse, x, y), model.sigma_px, model.outer
    u, z = at.t + model.ellipse.angle_rad, at.distance / sigma
    density = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    edge = ndtr(z) + 0.5 * at.curvature * sigma * density - model.kurtosis / 24.0 * (z**3 - 3.0 * z) * density
    ramp = at.distance * ndtr(z) + sigma * density
    radius = math.sqrt(float(model.ellipse.semi_axes_px.prod()))
    lean = model.lean[0] * np.cos(u) + model.lean[1] * np.sin(u)
    waves = [outer[2 * k - 1] * np.cos(k * u) + outer[2 * k] * np.sin(k * u) for k in range(1, (outer.size + 1) // 2)]
    beyond = model.slope + (waves[0] / radius if waves else 0.0)
    inner, outer_level = model.inner_dn + lean, outer[0] + sum(waves)
    return inner * (1.0 - edge) + outer_level * edge + lean / radius * (at.distance - ramp) + beyond * ramp


def pixel_profile(x: Floats, centre: float, sigma: float) -> Floats:
    """Mean over the pixel of exp(-(x - c)^2 / (2 s^2))."""
    scale = math.sqrt(0.5) / sigma
    low = (x - 0.5 - centre) * scale
    return np.asarray(sigma * math.sqrt(0.5 * math.pi) * (erf(low + scale) - erf(low)))
