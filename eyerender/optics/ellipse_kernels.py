"""Compiled direct least-squares fits of ellipses (see `ellipse.fit_ellipse_direct`)."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from ..base.arrays import Floats
from ..base.jit import compiled
from .formula_kernels import inlined, summed

Pair: TypeAlias = tuple[float, float]
Triple: TypeAlias = tuple[float, float, float]


@summed
def moments(x: Floats, y: Floats, mean_x: float, mean_y: float) -> Triple:
    """Compute mean square, mean product and mean square of two coordinates about their means."""
    xx, xy, yy = 0.0, 0.0, 0.0
    for k in range(len(x)):
        u, v = x[k] - mean_x, y[k] - mean_y
        xx, xy, yy = xx + u * u, xy + u * v, yy + v * v
    return xx / len(x), xy / len(x), yy / len(x)


@summed
def means(x: Floats, y: Floats) -> Pair:
    """Compute the means of two coordinates."""
    a, b = 0.0, 0.0
    for k in range(len(x)):
        a, b = a + x[k], b + y[k]
    return a / len(x), b / len(x)


@summed
def lean(basis: Floats, u: Floats, v: Floats) -> Pair:
    """Remove the part along u and v from a basis function, in place; return its coefficients."""
    a, b = 0.0, 0.0
    for k in range(len(u)):
        a, b = a + basis[k] * u[k], b + basis[k] * v[k]
    a, b = a / len(u), b / len(u)
    for k in range(len(u)):
        basis[k] -= a * u[k] + b * v[k]
    return a, b


@summed
def product(a: Floats, b: Floats) -> float:
    """Compute a mean product."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return float(total / len(a))


@inlined
def null_vector(pq: float, pr: float, qq: float, qr: float, rr: float, value: float) -> Triple:
    """Compute the null vector of M - value diag(1, -1, -1), normalised to w_p > 0.

    It is the first column of the adjugate: an ellipse has w_p^2 > w_q^2 + w_r^2, so no other column is longer.
    """
    d, f = qq + value, rr + value
    wp, wq, wr = d * f - qr * qr, pr * qr - pq * f, pq * qr - pr * d
    norm = np.copysign(np.sqrt(wp * wp + wq * wq + wr * wr), wp)
    return wp / norm, wq / norm, wr / norm


@inlined
def positive_eigenvector(pp: float, pq: float, pr: float, qq: float, qr: float, rr: float) -> Triple:
    """Compute the vector w of M w = lambda diag(1, -1, -1) w for the largest lambda; M is symmetric."""
    # Eigenvalues of diag(1, -1, -1) M, whose characteristic polynomial is x^3 - t x^2 + s x - det = 0.
    t = pp - qq - rr
    s = pq * pq + pr * pr - pp * (qq + rr) + qq * rr - qr * qr
    det = pp * (qq * rr - qr * qr) - pq * (pq * rr - qr * pr) + pr * (pq * qr - qq * pr)
    # All three roots are real because M is positive semi-definite. Viete's trigonometric form gives the largest.
    third = t / 3.0
    spread = np.sqrt(max(third * third - s / 3.0, 0.0))
    half = third * third * third - 0.5 * third * s + 0.5 * det
    cosine = min(max(half / max(spread * spread * spread, 1e-300), -1.0), 1.0)
    w = null_vector(pq, pr, qq, qr, rr, third + 2.0 * spread * np.cos(np.arccos(cosine) / 3.0))
    for _ in range(2):
        # The error of the Rayleigh quotient is the square of the vector's error, so it removes the cancellation in the
        # cubic.
        wp, wq, wr = w
        energy = pp * wp * wp + qq * wq * wq + rr * wr * wr + 2.0 * (pq * wp * wq + pr * wp * wr + qr * wq * wr)
        w = null_vector(pq, pr, qq, qr, rr, energy / (wp * wp - wq * wq - wr * wr))
    return w


@summed
def sampson_rms(work: Floats, w: Triple, quadratic: Triple, linear: Pair, factor: Triple) -> float:
    """Compute the root mean square sqrt(mean(F^2 / |grad F|^2)), px; L^-T takes the gradient back to pixels."""
    u, v, p, q, r = work[0], work[1], work[2], work[3], work[4]
    total = 0.0
    for k in range(len(u)):
        value = w[0] * p[k] + w[1] * q[k] + w[2] * r[k]
        gu = 2.0 * (quadratic[0] * u[k] + quadratic[1] * v[k]) - linear[0]
        gv = (2.0 * (quadratic[1] * u[k] + quadratic[2] * v[k]) - linear[1]) / factor[2]
        gx = (gu - factor[1] * gv) / factor[0]
        total += value * value / (gx * gx + gv * gv)
    return float(np.sqrt(total / len(u)))


@inlined
def fit_one(x: Floats, y: Floats, work: Floats, out: Floats) -> None:
    """Fit an ellipse to points, with memory `work` (5, k) for their coordinates and basis functions."""
    mean_x, mean_y = means(x, y)
    sxx, sxy, syy = moments(x, y, mean_x, mean_y)
    # Cholesky factor L of the covariance: (x, y) = L (u, v).
    l11 = np.sqrt(sxx)
    l21 = sxy / l11
    l22 = np.sqrt(syy - l21 * l21)
    u, v, p, q, r = work[0], work[1], work[2], work[3], work[4]
    for k in range(len(x)):
        u[k] = (x[k] - mean_x) / l11
        v[k] = (y[k] - mean_y - l21 * u[k]) / l22
        p[k], q[k], r[k] = u[k] * u[k] + v[k] * v[k] - 2.0, u[k] * u[k] - v[k] * v[k], 2.0 * u[k] * v[k]
    (pu, pv), (qu, qv), (ru, rv) = lean(p, u, v), lean(q, u, v), lean(r, u, v)
    w = positive_eigenvector(product(p, p), product(p, q), product(p, r), product(q, q), product(q, r), product(r, r))
    # F(u, v) = wp (u^2 + v^2 - 2) + wq (u^2 - v^2) + wr 2 u v - (d u + e v); quadratic part [[A, H], [H, C]].
    a2, h2, c2 = w[0] + w[1], w[2], w[0] - w[1]
    d, e = w[0] * pu + w[1] * qu + w[2] * ru, w[0] * pv + w[1] * qv + w[2] * rv
    det = a2 * c2 - h2 * h2
    cu, cv = 0.5 * (c2 * d - h2 * e) / det, 0.5 * (a2 * e - h2 * d) / det
    level = 2.0 * w[0] + 0.5 * (d * cu + e * cv)  # F = quadratic(u - cu) - level
    out[5] = sampson_rms(work, w, (a2, h2, c2), (d, e), (l11, l21, l22))
    # Back to pixels: the quadratic form Q becomes L^-T Q L^-1; the centre c becomes L c + mean.
    out[0], out[1] = l11 * cu + mean_x, l21 * cu + l22 * cv + mean_y
    # Inverse of Q/level is the form's covariance-like matrix P = level Q^-1; L P L^T has the semi-axes squared.
    scale = level / det
    p11, p12, p22 = scale * c2, -scale * h2, scale * a2
    g11, g12 = l11 * l11 * p11, l11 * (l21 * p11 + l22 * p12)
    g22 = l21 * l21 * p11 + 2.0 * l21 * l22 * p12 + l22 * l22 * p22
    axes(g11, g12, g22, out)
    # The points may be collinear to rounding error: the smaller spread is lost in the last digits of the larger one.
    fits = l22 * l11 > 1e-10 * (sxx + syy) and out[3] > 0.0
    for c in range(6):
        fits = fits and np.isfinite(out[c])
    if not fits:
        out[:5] = np.nan
        out[5] = np.inf


@inlined
def axes(g11: float, g12: float, g22: float, out: Floats) -> None:
    """Compute semi-axes and angle of {x : x^T G^-1 x = 1} from the eigenvalues and first eigenvector of G."""
    mean, half = 0.5 * (g11 + g22), 0.5 * (g11 - g22)
    major = mean + np.hypot(half, g12)
    # This is det / major because mean - radius cancels for a thin ellipse.
    out[2], out[3] = np.sqrt(major), np.sqrt((g11 * g22 - g12 * g12) / major)
    angle = 0.5 * np.arctan2(g12, half)
    angle = angle + np.pi if angle < 0.0 else angle
    out[4] = 0.0 if angle >= np.pi else angle


@compiled("f8[:,:,::1], f8[:,::1]")
def fit_all(points: Floats, out: Floats) -> None:
    """Fit ellipses to points (n, k, 2); rows of `out` (n, 6) are cx, cy, a, b, angle, residual."""
    x, y, work = np.empty(points.shape[1]), np.empty(points.shape[1]), np.empty((5, points.shape[1]))
    for i in range(len(points)):
        for k in range(len(x)):
            x[k], y[k] = points[i, k, 0], points[i, k, 1]
        fit_one(x, y, work, out[i])
