"""Algebraic fits of ellipses to points: the direct fit of a batch, and Taubin's fit."""

from __future__ import annotations

import math

import numpy as np

from ...base.arrays import Floats
from ...base.jit import compiled, inlined
from ..products import solve


@compiled("f8[:,:,::1]")
def direct_fits(points: Floats) -> Floats:
    """Fit direct ellipses (m, 5) to points (m, k, 2): centre, semi-axes and angle; NaN where there is none.

    Source: Halir and Flusser (1998), applied after an affine map that whitens the points.
    """
    out = np.empty((points.shape[0], 5))
    for m in range(points.shape[0]):
        for j in range(5):
            out[m, j] = math.nan
        _direct_fit(points[m], out[m])
    return out


@inlined
def _direct_fit(points: Floats, out: Floats) -> None:
    """Fit the direct ellipse to points (k, 2) and write it to out (5,), unless there is none."""
    k, mean_x, mean_y = points.shape[0], 0.0, 0.0
    for i in range(k):
        mean_x, mean_y = mean_x + points[i, 0] / k, mean_y + points[i, 1] / k
    sxx = sxy = syy = 0.0
    for i in range(k):
        x, y = points[i, 0] - mean_x, points[i, 1] - mean_y
        sxx, sxy, syy = sxx + x * x / k, sxy + x * y / k, syy + y * y / k
    if not sxx > 0.0:
        return
    # The Cholesky factor of the covariance maps whitened points (u, v) to these.
    l11 = math.sqrt(sxx)
    l21 = sxy / l11
    rest = syy - l21 * l21
    if not (rest > 0.0 and math.sqrt(rest) * l11 > 1e-10 * (sxx + syy)):
        return
    l22 = math.sqrt(rest)
    linear, quadratic = _conic_moments(points, (mean_x, mean_y, l11, l21, l22))
    wp, wq, wr = _elliptic_direction(quadratic)
    pu, pv, qu, qv, ru, rv = linear
    # The conic a2 u^2 + 2 h2 u v + c2 v^2 - d u - e v = constant.
    a2, h2, c2 = wp + wq, wr, wp - wq
    d, e = wp * pu + wq * qu + wr * ru, wp * pv + wq * qv + wr * rv
    det = a2 * c2 - h2 * h2
    cu, cv = 0.5 * (c2 * d - h2 * e) / det, 0.5 * (a2 * e - h2 * d) / det
    scale = (2.0 * wp + 0.5 * (d * cu + e * cv)) / det
    p11, p12, p22 = scale * c2, -scale * h2, scale * a2
    g11, g12 = l11 * l11 * p11, l11 * (l21 * p11 + l22 * p12)
    a, b, angle = _axes(g11, g12, l21 * l21 * p11 + 2.0 * l21 * l22 * p12 + l22 * l22 * p22)
    if b > 0.0 and math.isfinite(cu + cv):
        out[0], out[1], out[2], out[3] = l11 * cu + mean_x, l21 * cu + l22 * cv + mean_y, a, b
        out[4] = angle % math.pi


@inlined
def _conic_moments(points: Floats, rounding: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Compute moments of p = u^2 + v^2 - 2, q = u^2 - v^2 and r = 2 u v of the whitened points (u, v).

    `rounding` is the mean (x, y) of the points (k, 2), and the Cholesky factor (11, 21, 22) of their covariance.
    Returns the mean products pu, pv, qu, qv, ru, rv, and pp, pq, pr, qq, qr, rr without their part along u and v.
    """
    mean_x, mean_y, l11, l21, l22 = rounding
    k = points.shape[0]
    pu = pv = qu = qv = ru = rv = 0.0
    pp = pq = pr = qq = qr = rr = 0.0
    for i in range(k):
        u = (points[i, 0] - mean_x) / l11
        v = (points[i, 1] - mean_y - l21 * u) / l22
        p, q, r = u * u + v * v - 2.0, u * u - v * v, 2.0 * u * v
        pu, pv, qu, qv, ru, rv = pu + p * u, pv + p * v, qu + q * u, qv + q * v, ru + r * u, rv + r * v
        pp, pq, pr = pp + p * p, pq + p * q, pr + p * r
        qq, qr, rr = qq + q * q, qr + q * r, rr + r * r
    pu, pv, qu, qv, ru, rv = pu / k, pv / k, qu / k, qv / k, ru / k, rv / k
    pp, pq, pr = pp / k - pu * pu - pv * pv, pq / k - pu * qu - pv * qv, pr / k - pu * ru - pv * rv
    qq, qr, rr = qq / k - qu * qu - qv * qv, qr / k - qu * ru - qv * rv, rr / k - ru * ru - rv * rv
    return (pu, pv, qu, qv, ru, rv), (pp, pq, pr, qq, qr, rr)


@inlined
def _elliptic_direction(quadratic: tuple[float, ...]) -> tuple[float, float, float]:
    """Compute the unit vector w that minimises w^T S w / w^T C w, C = diag(1, -1, -1), among ellipses.

    The eigenvalue is the largest root of a cubic; two Rayleigh quotients polish it. `quadratic` holds S as 11, 12, 13,
    22, 23, 33.
    """
    pp, pq, pr, qq, qr, rr = quadratic
    trace = pp - qq - rr
    sums = pq * pq + pr * pr - pp * (qq + rr) + qq * rr - qr * qr
    det = pp * (qq * rr - qr * qr) - pq * (pq * rr - qr * pr) + pr * (pq * qr - qq * pr)
    third = trace / 3.0
    spread = math.sqrt(max(third * third - sums / 3.0, 0.0))
    half = third**3 - 0.5 * third * sums + 0.5 * det
    cosine = min(max(half / max(spread**3, 1e-300), -1.0), 1.0)
    value = third + 2.0 * spread * math.cos(math.acos(cosine) / 3.0)
    wp = wq = wr = 0.0
    for turn in range(3):
        if turn > 0:
            energy = pp * wp * wp + qq * wq * wq + rr * wr * wr
            energy += 2.0 * (pq * wp * wq + pr * wp * wr + qr * wq * wr)
            value = energy / (wp * wp - wq * wq - wr * wr)
        d, f = qq + value, rr + value
        wp, wq, wr = d * f - qr * qr, pr * qr - pq * f, pq * qr - pr * d
        norm = math.copysign(math.sqrt(wp * wp + wq * wq + wr * wr), wp)
        wp, wq, wr = wp / norm, wq / norm, wr / norm
    return wp, wq, wr


@inlined
def taubin_fit(points: Floats, weight: Floats, out: Floats) -> bool:
    """Fit Taubin's ellipse to points (n, 2) with weights (n,) and write it to out (5,); return False if there is none.

    The conic (x^2, x y, y^2, x, y, 1) . v minimises its mean square value over the mean square of its gradient.
    `cv2.fitEllipseAMS` computes the same in single precision. Source: Taubin (1991).
    """
    mean_x, mean_y, scale = _unit(points, weight)
    if not scale > 0.0:
        return False
    mean, scatter, gradient = _scatter(points, weight, mean_x, mean_y, scale)
    conic = _least_direction(scatter, gradient)
    a, b, c, d, e = conic[0], conic[1], conic[2], conic[3], conic[4]
    f = -(a * mean[0] + b * mean[1] + c * mean[2] + d * mean[3] + e * mean[4])
    det = 4.0 * a * c - b * b
    if not det > 0.0:
        return False
    x, y = (b * e - 2.0 * c * d) / det, (b * d - 2.0 * a * e) / det
    factor = -4.0 * (f + 0.5 * (d * x + e * y)) / det
    major, minor, angle = _axes(factor * c, -0.5 * factor * b, factor * a)
    if not (minor > 0.0 and major < 25.0):
        return False
    out[0], out[1], out[2], out[3] = x * scale + mean_x, y * scale + mean_y, major * scale, minor * scale
    out[4] = angle % math.pi
    return True


@inlined
def _least_direction(scatter: Floats, gradient: Floats) -> Floats:
    """Return the v (5,) that minimises v^T S v / v^T G v, by inverse iteration; its largest element is 1 or -1."""
    ridge = 0.0
    for j in range(5):
        ridge += 1e-15 * scatter[j, j]
    for j in range(5):
        scatter[j, j] += ridge
    found, pull = np.array([1.0, 0.5, 1.0, 1.0, 1.0]), np.empty(5)
    for _ in range(50):
        for j in range(5):
            pull[j] = 0.0
            for m in range(5):
                pull[j] += gradient[j, m] * found[m]
        solve(scatter.copy(), pull)
        size = change = 0.0
        for j in range(5):
            size = max(size, abs(pull[j]))
        for j in range(5):
            change = max(change, abs(pull[j] / size - found[j]))
            found[j] = pull[j] / size
        if change < 1e-11:
            break
    return found


@inlined
def _unit(points: Floats, weight: Floats) -> tuple[float, float, float]:
    """Compute the weighted mean of points (n, 2) and their largest offset, for scaling to small numbers about 0."""
    total = x = y = scale = 0.0
    for i in range(weight.size):
        total, x, y = total + weight[i], x + weight[i] * points[i, 0], y + weight[i] * points[i, 1]
    x, y = x / total, y / total
    for i in range(weight.size):
        if weight[i] > 0.0:
            scale = max(scale, abs(points[i, 0] - x), abs(points[i, 1] - y))
    return x, y, scale


@inlined
def _scatter(
    points: Floats, weight: Floats, mean_x: float, mean_y: float, scale: float
) -> tuple[Floats, Floats, Floats]:
    """Compute mean (5,) and covariance (5, 5) of (x^2, x y, y^2, x, y), scaled points, and gradient products (5, 5)."""
    total, mean, scatter, gradient = 0.0, np.zeros(5), np.zeros((5, 5)), np.zeros((5, 5))
    z, by_x, by_y = np.empty(5), np.array([0.0, 0.0, 0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    for i in range(weight.size):
        if weight[i] <= 0.0:
            continue
        x, y, w = (points[i, 0] - mean_x) / scale, (points[i, 1] - mean_y) / scale, weight[i]
        z[0], z[1], z[2], z[3], z[4] = x * x, x * y, y * y, x, y
        by_x[0], by_x[1], by_y[1], by_y[2] = 2.0 * x, y, x, 2.0 * y
        total += w
        for j in range(5):
            mean[j] += w * z[j]
            for m in range(5):
                scatter[j, m] += w * z[j] * z[m]
                gradient[j, m] += w * (by_x[j] * by_x[m] + by_y[j] * by_y[m])
    for j in range(5):
        mean[j] /= total
    for j in range(5):
        for m in range(5):
            scatter[j, m] = scatter[j, m] / total - mean[j] * mean[m]
            gradient[j, m] /= total
        gradient[j, j] += 1e-12
    return mean, scatter, gradient


@inlined
def _axes(g11: float, g12: float, g22: float) -> tuple[float, float, float]:
    """Compute semi-axes and angle of the ellipse with this shape matrix; NaN if there is none."""
    mean, half = 0.5 * (g11 + g22), 0.5 * (g11 - g22)
    major = mean + math.sqrt(half * half + g12 * g12)
    minor = (g11 * g22 - g12 * g12) / major
    if not (major > 0.0 and minor > 0.0):
        return math.nan, math.nan, math.nan
    return math.sqrt(major), math.sqrt(minor), 0.5 * math.atan2(g12, half)
