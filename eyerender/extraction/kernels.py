"""The compiled functions of the search and the boundary (see `compiled`).

Each has the name, arguments and results of its twin, documented there. They are loops over pixels or points.
"""

from __future__ import annotations

import math

import numpy as np

from ..jit import compiled, inlined

SECTORS, NEAR = 48, 2  # as in edge_model
DARK, SHADED = 0.35, 0.6  # as in outline
WEAK = 0.2  # as in edges
MOST_BLOBS = 12  # as in candidates
SELECTION = 1.6  # as in covariance


BLOCK = 128  # points whose numbers stay in the first-level cache
_LIMITS = [math.tan(math.radians(7.5 * k)) for k in range(1, 6)]  # of the sectors within an eighth of the outline
_FIRST, _SECOND, _THIRD, _FOURTH, _FIFTH = _LIMITS


@inlined
def places(ellipse, x, y, start, count, steps, out):
    """`Place.of` of `count` points from `start` on, as columns of out (8 BLOCK,), one after the other.

    These are loops over simple sums, which the compiler turns into vector instructions.
    """
    cx, cy, a, b, angle = ellipse
    cos, sin, eccentric = math.cos(angle), math.sin(angle), a * a - b * b
    for i in range(count):
        dx, dy = x[start + i] - cx, y[start + i] - cy
        p, q = dx * cos + dy * sin, dy * cos - dx * sin
        c, s = p / a, q / b
        scale = 1.0 / max(math.sqrt(c * c + s * s), 1e-300)
        out[BLOCK + i], out[2 * BLOCK + i], out[6 * BLOCK + i], out[7 * BLOCK + i] = c * scale, s * scale, p, q
    if eccentric > 1e-9 * a * a:
        for _ in range(steps):
            for i in range(count):
                c, s, ap, bq = out[BLOCK + i], out[2 * BLOCK + i], a * out[6 * BLOCK + i], b * out[7 * BLOCK + i]
                value = eccentric * c * s - ap * s + bq * c
                slope = eccentric * (c * c - s * s) - ap * c - bq * s
                turn = min(max(value / min(slope, -1e-9), -0.3), 0.3)
                c, s = c + turn * s, s - turn * c
                scale = 1.0 / math.sqrt(c * c + s * s)
                out[BLOCK + i], out[2 * BLOCK + i] = c * scale, s * scale
    for i in range(count):
        c, s, p, q = out[BLOCK + i], out[2 * BLOCK + i], out[6 * BLOCK + i], out[7 * BLOCK + i]
        nx, ny = b * c, a * s
        scale = 1.0 / math.sqrt(nx * nx + ny * ny)
        nx, ny = nx * scale, ny * scale
        out[i] = (p - a * c) * nx + (q - b * s) * ny
        out[3 * BLOCK + i], out[4 * BLOCK + i], out[5 * BLOCK + i] = nx, ny, a * b * scale * scale * scale
        out[6 * BLOCK + i], out[7 * BLOCK + i] = c * cos - s * sin, s * cos + c * sin


@inlined
def sector_at(c, s):
    """`sector_of` of a direction, without its angle: by the ratio of the smaller to the larger component."""
    x, y = abs(c), abs(s)
    t = min(x, y) / max(x, y)
    k = (t >= _FIRST) + (t >= _SECOND) + (t >= _THIRD) + (t >= _FOURTH) + (t >= _FIFTH)
    k = k if y <= x else 11 - k
    k = k if c >= 0.0 else 23 - k
    return 24 + k if s >= 0.0 else 23 - k


@inlined
def _sectors(ellipse, x, y, steps, out):
    """Write the sector of each point."""
    place = np.empty(8 * BLOCK)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        places(ellipse, x, y, start, count, steps, place)
        for i in range(count):
            out[start + i] = sector_at(place[6 * BLOCK + i], place[7 * BLOCK + i])


@inlined
def _holding(ellipse, points, steps):
    """Whether each sector holds a point."""
    flat, own = points.T.copy(), np.empty(points.shape[0], dtype=np.int64)
    _sectors(ellipse, flat[0], flat[1], steps, own)
    out = np.zeros(SECTORS, dtype=np.bool_)
    for k in own:
        out[k] = True
    return out


@compiled
def edge_sums(ellipse, points, sectors):
    cos, sin = math.cos(ellipse[4]), math.sin(ellipse[4])
    matrix, scores, slopes = np.zeros((5, 5)), np.zeros((5, sectors)), np.zeros((5, sectors))
    number, row, place, flat = np.zeros(sectors, dtype=np.int64), np.empty(5), np.empty(8 * BLOCK), points.T.copy()
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        places(ellipse, flat[0], flat[1], start, count, 3, place)
        for i in range(count):
            c, s, nx, ny = place[BLOCK + i], place[2 * BLOCK + i], place[3 * BLOCK + i], place[4 * BLOCK + i]
            row[0], row[1] = ny * sin - nx * cos, -nx * sin - ny * cos
            row[2], row[3], row[4] = -nx * c, -ny * s, -nx * s - ny * c
            k = sector_at(place[6 * BLOCK + i], place[7 * BLOCK + i]) * sectors // SECTORS
            number[k] += 1
            for j in range(5):
                scores[j, k] += row[j] * place[i]
                slopes[j, k] += row[j]
                for m in range(j + 1):
                    matrix[j, m] += row[j] * row[m]
    for j in range(5):
        for m in range(j):
            matrix[m, j] = matrix[j, m]
    return matrix, scores, slopes, number


@inlined
def _inverse(matrix):
    ridge = 0.0
    for j in range(5):
        ridge += 1e-9 * matrix[j, j]
    return np.linalg.inv(matrix + ridge * np.eye(5))


@compiled
def of_edges(matrix, scores, count, residual_px):
    inverse = _inverse(matrix)
    variance = max(residual_px, 1e-4) ** 2
    groups = 0
    for k in range(count.size):
        groups += count[k] > 0
    groups = max(groups, 6)
    # The trace of plain^-1 (inverse scores) (inverse scores)^T, with plain = variance inverse.
    excess = 0.0
    for k in range(scores.shape[1]):
        for j in range(5):
            for m in range(5):
                excess += scores[j, k] * inverse[j, m] * scores[m, k]
    excess *= groups / (groups - 5.0) / (5.0 * variance)
    return inverse * (variance * max(excess, 1.0) * SELECTION)


@compiled
def followed(matrix, slopes):
    moved = _inverse(matrix) @ slopes
    return moved @ moved.T


@compiled
def along_outline(ellipse, covariance):
    a, b, angle = ellipse[2], ellipse[3], ellipse[4]
    cos, sin, total, row = math.cos(angle), math.sin(angle), 0.0, np.empty(5)
    for k in range(32):
        t = 2.0 * math.pi * ((k + 0.5) / 32 - 0.5) - angle
        c, s = math.cos(t), math.sin(t)
        nx, ny = b * c, a * s
        height = math.sqrt(nx * nx + ny * ny)
        nx, ny = nx / height, ny / height
        row[0], row[1] = ny * sin - nx * cos, -nx * sin - ny * cos
        row[2], row[3], row[4] = -nx * c, -ny * s, -nx * s - ny * c
        for j in range(5):
            for m in range(5):
                total += row[j] * covariance[j, m] * row[m]
    return math.sqrt(max(total / 32, 0.0))


@compiled
def differences(linear, step):
    rows, columns = (linear.shape[0] - 2) // step + 1, (linear.shape[1] - 2) // step + 1
    out = np.empty(rows * columns, dtype=np.float32)
    for k in range(rows):
        above, below = linear[k * step], linear[k * step + 1]
        for m in range(columns):
            i = m * step
            out[k * columns + m] = abs(above[i] - above[i + 1] - below[i] + below[i + 1])
    return out


@compiled
def support(points, normals, fits, tolerance):
    out = np.zeros(fits.shape[0])
    for m in range(fits.shape[0]):
        cx, cy, a, b, angle = fits[m]
        cos, sin = math.cos(angle), math.sin(angle)
        total = 0.0
        for i in range(points.shape[0]):
            dx, dy = points[i, 0] - cx, points[i, 1] - cy
            p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
            radius2 = p * p + q * q
            nx, ny = p / a, q / b
            slope2 = nx * nx + ny * ny
            # The distance is (radius - 1) radius / slope.
            radius = math.sqrt(radius2)
            distance2 = (radius - 1.0) ** 2 * radius2 / slope2
            if distance2 >= tolerance * tolerance:
                continue
            along = (nx * cos - ny * sin) * normals[i, 0] + (nx * sin + ny * cos) * normals[i, 1]
            if along > 0.9 * math.sqrt(slope2):
                total += 1.0 - distance2 / (tolerance * tolerance)
        out[m] = total / math.sqrt(math.pi * (a + b))
    return out


@inlined
def _select(points, normals, ellipse, sigma_px, reach, clipped, moved, distance, chosen):
    """Move points by the curvature shift and choose those near an ellipse; returns how many were chosen."""
    cx, cy, a, b, angle = ellipse[0], ellipse[1], ellipse[2], ellipse[3], ellipse[4]
    cos, sin = math.cos(angle), math.sin(angle)
    n, count = points.shape[0], 0
    for i in range(n):
        dx, dy = points[i, 0] - cx, points[i, 1] - cy
        p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
        radius = max(math.sqrt(p * p + q * q), 1e-12)
        u, v = p / a, q / b
        slope = max(math.sqrt(u * u + v * v), 1e-12)
        nx, ny = (u * cos - v * sin) / slope, (u * sin + v * cos) / slope
        curvature = (radius / slope) ** 3 / (a * b) ** 2
        shift = min(0.5 * sigma_px * sigma_px * curvature, 0.15 * b)
        moved[i, 0], moved[i, 1] = points[i, 0] + shift * nx, points[i, 1] + shift * ny
        distance[i] = (radius - 1.0) * radius / slope + shift
        chosen[i] = abs(distance[i]) < reach and nx * normals[i, 0] + ny * normals[i, 1] > 0.9
        count += chosen[i]
    if clipped and count >= 8:
        some = distance[chosen]
        limit = max(3.5 * 1.4826 * median_of(np.abs(some - median_of(some))), 0.1)
        count = 0
        for i in range(n):
            chosen[i] = chosen[i] and abs(distance[i]) < limit
            count += chosen[i]
    return count


@inlined
def _axes(g11, g12, g22):
    """`_axes_from_shape_matrix` of the geometry, for one ellipse: a, b, angle."""
    mean, half = 0.5 * (g11 + g22), 0.5 * (g11 - g22)
    major = mean + math.sqrt(half * half + g12 * g12)
    minor = (g11 * g22 - g12 * g12) / major
    if not (major > 0.0 and minor > 0.0):
        return math.nan, math.nan, math.nan
    return math.sqrt(major), math.sqrt(minor), 0.5 * math.atan2(g12, half)


@inlined
def _unit(points, chosen):
    """Mean and largest offset of the chosen points: what makes them small numbers about 0."""
    n, x, y, scale = chosen.sum(), 0.0, 0.0, 0.0
    for i in range(chosen.size):
        if chosen[i]:
            x, y = x + points[i, 0] / n, y + points[i, 1] / n
    for i in range(chosen.size):
        if chosen[i]:
            scale = max(scale, abs(points[i, 0] - x), abs(points[i, 1] - y))
    return x, y, scale


@inlined
def _scatter(points, chosen, mean_x, mean_y, scale):
    """Mean (5,) of (x^2, x y, y^2, x, y), its covariance (5, 5), and that of its derivatives by x and y."""
    n = chosen.sum()
    mean, scatter, gradient = np.zeros(5), np.zeros((5, 5)), np.zeros((5, 5))
    z, by_x, by_y = np.empty(5), np.zeros(5), np.zeros(5)
    by_x[3] = by_y[4] = 1.0
    for i in range(chosen.size):
        if chosen[i]:
            x, y = (points[i, 0] - mean_x) / scale, (points[i, 1] - mean_y) / scale
            z[0], z[1], z[2], z[3], z[4] = x * x, x * y, y * y, x, y
            by_x[0], by_x[1], by_y[1], by_y[2] = 2.0 * x, y, x, 2.0 * y
            for j in range(5):
                mean[j] += z[j] / n
                for m in range(5):
                    scatter[j, m] += z[j] * z[m] / n
                    gradient[j, m] += (by_x[j] * by_x[m] + by_y[j] * by_y[m]) / n
    for j in range(5):
        for m in range(5):
            scatter[j, m] -= mean[j] * mean[m]
        gradient[j, j] += 1e-12
    return mean, scatter, gradient


@inlined
def factored(matrix):
    """Cholesky's factor (lower) of a matrix, in place."""
    n = matrix.shape[0]
    for j in range(n):
        for i in range(j, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(max(total, 1e-300)) if i == j else total / matrix[j, j]


@inlined
def solved(lower, vector):
    """Solve L L^T x = vector in place."""
    n = vector.size
    for i in range(n):
        for k in range(i):
            vector[i] -= lower[i, k] * vector[k]
        vector[i] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            vector[i] -= lower[k, i] * vector[k]
        vector[i] /= lower[i, i]


@inlined
def _least_direction(scatter, gradient):
    """The v (5,) of the least v^T S v / v^T G v, by inverse iteration."""
    trace = 0.0
    for j in range(5):
        trace += scatter[j, j]
    for j in range(5):
        scatter[j, j] += 1e-15 * trace
    factored(scatter)
    found = np.ones(5)
    found[1] = 0.5
    new = np.empty(5)
    for _ in range(50):
        for j in range(5):
            new[j] = 0.0
            for m in range(5):
                new[j] += gradient[j, m] * found[m]
        solved(scatter, new)
        size = 0.0
        for j in range(5):
            size = max(size, abs(new[j]))
        change = 0.0
        for j in range(5):
            new[j] /= size
            change = max(change, abs(new[j] - found[j]))
            found[j] = new[j]
        if change < 1e-11:
            break
    return found


@inlined
def _taubin(points, chosen, out):
    """Taubin's approximate mean square fit, as `cv2.fitEllipseAMS`, in double precision; False where it is none."""
    mean_x, mean_y, scale = _unit(points, chosen)
    if not scale > 0.0:
        return False
    mean, scatter, gradient = _scatter(points, chosen, mean_x, mean_y, scale)
    conic = _least_direction(scatter, gradient)
    a, b, c, d, e = conic[0], conic[1], conic[2], conic[3], conic[4]
    f = 0.0
    for j in range(5):
        f -= conic[j] * mean[j]
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


@compiled
def settled(points, normals, start, sigma_px, tolerance):
    n = points.shape[0]
    ellipse, moved, nothing = start.copy(), np.empty((n, 2)), np.zeros(3)
    distance, chosen, inliers = np.empty(n), np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    for turn in range(5):
        reach = 2.0 * tolerance if turn == 0 else tolerance
        count = _select(points, normals, ellipse, sigma_px, reach, turn >= 1, moved, distance, chosen)
        if count < 8:
            return count, ellipse, chosen, moved, nothing
        same = turn > 1
        for i in range(n):
            same = same and chosen[i] == inliers[i]
            inliers[i] = chosen[i]
        if not _taubin(moved, inliers, ellipse):
            return -1, ellipse, inliers, moved, nothing
        if same:
            break
    return count, ellipse, inliers, moved, _seen(ellipse, moved, inliers)


@inlined
def _seen(ellipse, points, chosen):
    """Share of the outline that holds points, that of the longest gap, and the root mean square distance."""
    cx, cy, a, b, angle = ellipse[0], ellipse[1], ellipse[2], ellipse[3], ellipse[4]
    cos, sin = math.cos(angle), math.sin(angle)
    held, square, count = np.zeros(SECTORS, dtype=np.bool_), 0.0, 0
    for i in range(chosen.size):
        if chosen[i]:
            dx, dy = points[i, 0] - cx, points[i, 1] - cy
            p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
            held[sector_at(p, q)] = True
            radius2, u, v = p * p + q * q, p / a, q / b
            square += (math.sqrt(radius2) - 1.0) ** 2 * radius2 / max(u * u + v * v, 1e-24)
            count += 1
    run = longest = full = 0
    for k in range(2 * SECTORS):
        run = 0 if held[k % SECTORS] else run + 1
        longest = max(longest, run)
        full += held[k % SECTORS]
    return np.array([0.5 * full / SECTORS, min(longest, SECTORS) / SECTORS, math.sqrt(square / count)])


@compiled
def direct_fits(points):
    out = np.full((points.shape[0], 5), np.nan)
    k = points.shape[1]
    for m in range(points.shape[0]):
        mean_x, mean_y = 0.0, 0.0
        for i in range(k):
            mean_x += points[m, i, 0] / k
            mean_y += points[m, i, 1] / k
        sxx, sxy, syy = 0.0, 0.0, 0.0
        for i in range(k):
            x, y = points[m, i, 0] - mean_x, points[m, i, 1] - mean_y
            sxx, sxy, syy = sxx + x * x / k, sxy + x * y / k, syy + y * y / k
        if not sxx > 0.0:
            continue
        l11 = math.sqrt(sxx)
        l21 = sxy / l11
        rest = syy - l21 * l21
        if not (rest > 0.0 and math.sqrt(rest) * l11 > 1e-10 * (sxx + syy)):
            continue
        l22 = math.sqrt(rest)
        # The moments of the whitened points give those of the basis (p, q, r) without its linear part (u, v).
        pu = pv = qu = qv = ru = rv = 0.0
        pp = pq = pr = qq = qr = rr = 0.0
        for i in range(k):
            u = (points[m, i, 0] - mean_x) / l11
            v = (points[m, i, 1] - mean_y - l21 * u) / l22
            p, q, r = u * u + v * v - 2.0, u * u - v * v, 2.0 * u * v
            pu, pv, qu, qv, ru, rv = pu + p * u, pv + p * v, qu + q * u, qv + q * v, ru + r * u, rv + r * v
            pp, pq, pr = pp + p * p, pq + p * q, pr + p * r
            qq, qr, rr = qq + q * q, qr + q * r, rr + r * r
        pu, pv, qu, qv, ru, rv = pu / k, pv / k, qu / k, qv / k, ru / k, rv / k
        pp, pq, pr = pp / k - pu * pu - pv * pv, pq / k - pu * qu - pv * qv, pr / k - pu * ru - pv * rv
        qq, qr, rr = qq / k - qu * qu - qv * qv, qr / k - qu * ru - qv * rv, rr / k - ru * ru - rv * rv
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
        a2, h2, c2 = wp + wq, wr, wp - wq
        d, e = wp * pu + wq * qu + wr * ru, wp * pv + wq * qv + wr * rv
        det = a2 * c2 - h2 * h2
        cu, cv = 0.5 * (c2 * d - h2 * e) / det, 0.5 * (a2 * e - h2 * d) / det
        scale = (2.0 * wp + 0.5 * (d * cu + e * cv)) / det
        p11, p12, p22 = scale * c2, -scale * h2, scale * a2
        g11 = l11 * l11 * p11
        g12 = l11 * (l21 * p11 + l22 * p12)
        g22 = l21 * l21 * p11 + 2.0 * l21 * l22 * p12 + l22 * l22 * p22
        a, b, angle = _axes(g11, g12, g22)
        if b > 0.0 and math.isfinite(cu + cv):
            out[m, 0], out[m, 1], out[m, 2], out[m, 3] = l11 * cu + mean_x, l21 * cu + l22 * cv + mean_y, a, b
            out[m, 4] = angle % math.pi
    return out


BUCKETS = 256


@inlined
def _ranked(values, rank):
    """The value before which `rank` of values (n,) come in ascending order.

    They are counted in buckets, then those of the right bucket in smaller ones, until all in a bucket are equal.
    """
    some, count = values, np.empty(BUCKETS, dtype=np.int64)
    while True:
        least, most = some.min(), some.max()
        if least == most:
            return float(least)
        count[:], scale, bucket = 0, (BUCKETS - 1e-3) / (float(most) - float(least)), 0
        for i in range(some.size):
            count[int((float(some[i]) - least) * scale)] += 1
        while rank >= count[bucket]:
            rank -= count[bucket]
            bucket += 1
        inside, size = np.empty(count[bucket], dtype=values.dtype), 0
        for i in range(some.size):
            if int((float(some[i]) - least) * scale) == bucket:
                inside[size] = some[i]
                size += 1
        some = inside


@inlined
def quantile_of(values, share):
    """`statistics.quantile` of values (n,), which stay as they are."""
    if values.size == 0:
        return math.nan
    at = share * (values.size - 1)
    low = math.floor(at)
    first, second, upto = _ranked(values, int(low)), math.inf, 0
    if low == at:
        return first
    for i in range(values.size):
        if values[i] > first:
            second = min(second, float(values[i]))
        else:
            upto += 1
    return first if upto > low + 1 else first + (at - low) * (second - first)


@inlined
def median_of(values):
    return quantile_of(values, 0.5)


@compiled
def median_off(ellipse, points, sigma_px):
    cx, cy, a, b, angle = ellipse
    cos, sin, off = math.cos(angle), math.sin(angle), np.empty(points.shape[0])
    for i in range(off.size):
        dx, dy = points[i, 0] - cx, points[i, 1] - cy
        p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
        radius = max(math.sqrt(p * p + q * q), 1e-12)
        slope = max(math.sqrt((p / a) ** 2 + (q / b) ** 2), 1e-12)
        curvature = (radius / slope) ** 3 / (a * b) ** 2
        off[i] = abs((radius - 1.0) * radius / slope + 0.5 * sigma_px * sigma_px * curvature)
    return median_of(off)


@compiled
def ridges(gx, gy, magnitude, covered, ellipse, half_band, floor):
    cx, cy, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    height, width = magnitude.shape
    reach_x = (1.0 + half_band) * math.sqrt((a * cos) ** 2 + (b * sin) ** 2) + 1.0
    reach_y = (1.0 + half_band) * math.sqrt((a * sin) ** 2 + (b * cos) ** 2) + 1.0
    x0, x1 = max(1, int(cx - reach_x)), min(width - 1, int(cx + reach_x) + 2)
    y0, y1 = max(1, int(cy - reach_y)), min(height - 1, int(cy + reach_y) + 2)
    inner2, outer2 = max(1.0 - half_band, 0.0) ** 2, (1.0 + half_band) ** 2
    size = max(x1 - x0, 0) * max(y1 - y0, 0)
    row, column, here = np.empty(size, dtype=np.int32), np.empty(size, dtype=np.int32), np.empty(size, dtype=np.float32)
    n = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            strength = magnitude[y, x]
            if not strength > floor or covered[y, x]:
                continue
            p, q = ((x - cx) * cos + (y - cy) * sin) / a, ((y - cy) * cos - (x - cx) * sin) / b
            radius2 = p * p + q * q
            if (radius2 <= inner2 and half_band < 1.0) or radius2 >= outer2:
                continue
            u, v = p * (cos / a) - q * (sin / b), p * (sin / a) + q * (cos / b)
            if gx[y, x] * u + gy[y, x] * v > 0.7 * strength * max(math.sqrt(u * u + v * v), 1e-12):
                row[n], column[n], here[n] = y, x, strength
                n += 1
    least = WEAK * quantile_of(here[:n], 0.9) if n else 0.0
    found = 0
    for i in range(n):
        y, x, strength = row[i], column[i], here[i]
        if abs(gx[y, x]) >= abs(gy[y, x]):
            before, after = magnitude[y, x - 1], magnitude[y, x + 1]
        else:
            before, after = magnitude[y - 1, x], magnitude[y + 1, x]
        if strength > before and strength >= after and strength > least:
            row[found], column[found] = y, x
            found += 1
    points, normals, widths = np.empty((found, 2)), np.empty((found, 2)), np.empty(found)
    for i in range(found):
        widths[i] = _vertex(gx, gy, magnitude, row[i], column[i], points[i], normals[i])
    return points, normals, widths, row[:found].copy(), column[:found].copy()


@inlined
def _vertex(gx, gy, magnitude, y, x, point, normal):
    """Write the sub-pixel place of a ridge and its normal; returns the squared width of the profile."""
    level = abs(gx[y, x]) >= abs(gy[y, x])
    if level:
        before, after = magnitude[y, x - 1], magnitude[y, x + 1]
    else:
        before, after = magnitude[y - 1, x], magnitude[y + 1, x]
    strength = magnitude[y, x]
    first, middle, last = math.log(max(before, 1e-3)), math.log(max(strength, 1e-3)), math.log(max(after, 1e-3))
    bend = min(first - 2.0 * middle + last, -1e-4)
    offset = min(max(0.5 * (first - last) / bend, -0.75), 0.75)
    point[0], point[1] = (x + offset, float(y)) if level else (float(x), y + offset)
    normal[0], normal[1] = float(gx[y, x]) / strength, float(gy[y, x]) / strength
    lean = abs(normal[0]) if level else abs(normal[1])
    return lean * lean / -bend


@inlined
def _nearest(image, x, y):
    column = min(max(int(np.rint(x)), 0), image.shape[1] - 1)
    return image[min(max(int(np.rint(y)), 0), image.shape[0] - 1), column]


@compiled
def at_the_iris(smooth, points, normals, depth, limits):
    pupil, dark, iris, clear, bright, rise = limits
    out = np.empty(points.shape[0], dtype=np.bool_)
    for i in range(out.size):
        x, y, u, v = points[i, 0], points[i, 1], depth * normals[i, 0], depth * normals[i, 1]
        behind, ahead = _nearest(smooth, x - u, y - v), _nearest(smooth, x + u, y + v)
        mirrored = behind - pupil >= dark and behind - pupil < iris and ahead - behind > clear
        out[i] = (
            (behind - pupil < dark or mirrored)
            and _nearest(smooth, x + 0.5 * u, y + 0.5 * v) - (behind if mirrored else pupil) < bright
            and _nearest(smooth, x + 1.5 * u, y + 1.5 * v) - ahead < rise
        )
    return out


@compiled
def interior(crop, hidden, ellipse, end):
    cx, cy, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    core, ring = np.empty(crop.size, dtype=np.float32), np.empty(crop.size, dtype=np.float32)
    inside = np.empty(crop.size, dtype=np.float32)
    whole = max(end, 0.5) ** 2
    low, high = (end - 0.25) ** 2, end**2
    n_core = n_ring = n_inside = 0
    for shown in (True, False):
        middle = covered = n_core = n_ring = n_inside = 0
        for y in range(crop.shape[0]):
            for x in range(crop.shape[1]):
                p, q = ((x - cx) * cos + (y - cy) * sin) / a, ((y - cy) * cos - (x - cx) * sin) / b
                square = p * p + q * q
                if square < 0.35**2:
                    middle += 1
                    covered += hidden[y, x]
                if shown and hidden[y, x]:
                    continue
                if square < 0.35**2:
                    core[n_core] = crop[y, x]
                    n_core += 1
                if low < square < high:
                    ring[n_ring] = crop[y, x]
                    n_ring += 1
                if square < whole:
                    inside[n_inside] = crop[y, x]
                    n_inside += 1
        if covered < 0.5 * middle:
            break
    inside = inside[:n_inside]
    spread = quantile_of(inside, 0.75) - quantile_of(inside, 0.25) if n_inside >= 8 else 0.0
    return median_of(ring[:n_ring]) - median_of(core[:n_core]), n_core, n_ring, spread


@inlined
def _beside(ellipse, k, sectors, away, linear, corner, patch):
    """Level at the pixel `away` outside an ellipse, in the middle of sector k."""
    cx, cy, a, b, angle = ellipse
    cos, sin, t = math.cos(angle), math.sin(angle), 2.0 * math.pi * ((k + 0.5) / sectors - 0.5) - angle
    c, s = math.cos(t), math.sin(t)
    nx, ny = b * c, a * s
    height = math.sqrt(nx * nx + ny * ny)
    p, q = a * c + away * nx / height, b * s + away * ny / height
    column = min(max(int(np.rint(cx + p * cos - q * sin)), 0), linear.shape[1] - 1)
    row = min(max(int(np.rint(cy + p * sin + q * cos)), 0), linear.shape[0] - 1)
    i, j = row - corner[1], column - corner[0]
    if 0 <= i < patch.shape[0] and 0 <= j < patch.shape[1]:
        return patch[i, j]
    return linear[row, column]


@compiled
def standing_out(crop, level, bright, by):
    out = np.empty(crop.shape, dtype=np.uint8)
    for y in range(crop.shape[0]):
        for x in range(crop.shape[1]):
            out[y, x] = crop[y, x] > bright and crop[y, x] - level[y, x] > by
    return out


@compiled
def levels_beside(ellipse, away_px, sectors, linear, corner, patch):
    out = np.empty(sectors, dtype=np.float32)
    for k in range(sectors):
        out[k] = _beside(ellipse, k, sectors, away_px, linear, corner, patch)
    return out


@compiled
def held(ellipse, points):
    hit, grown = _holding(ellipse, points, 3), np.empty(SECTORS, dtype=np.bool_)
    for k in range(SECTORS):
        grown[k] = hit[k] or hit[k - 1] or hit[(k + 1) % SECTORS]
    for k in range(SECTORS):
        hit[k] = hit[k] or (grown[k] and grown[k - 1] and grown[(k + 1) % SECTORS])
    return hit


@inlined
def _chord(ellipse, y):
    """Ends of the horizontal chord of an ellipse at a height."""
    cx, cy, a, b, angle = ellipse
    cos, sin, dy = math.cos(angle), math.sin(angle), y - cy
    square, mixed = (cos / a) ** 2 + (sin / b) ** 2, cos * sin * (1.0 / (a * a) - 1.0 / (b * b)) * dy
    root = math.sqrt(max(mixed * mixed - square * (((sin / a) ** 2 + (cos / b) ** 2) * dy * dy - 1.0), 0.0))
    return cx - (mixed + root) / square, cx - (mixed - root) / square


@compiled
def overlap(first, second):
    nodes = 128
    high_1 = math.sqrt((first[2] * math.sin(first[4])) ** 2 + (first[3] * math.cos(first[4])) ** 2)
    high_2 = math.sqrt((second[2] * math.sin(second[4])) ** 2 + (second[3] * math.cos(second[4])) ** 2)
    low, high = max(first[1] - high_1, second[1] - high_2), min(first[1] + high_1, second[1] + high_2)
    if low >= high:
        return 0.0
    common = 0.0
    for k in range(nodes):
        t = (k + 0.5) * (math.pi / nodes) - 0.5 * math.pi
        y = 0.5 * (low + high) + 0.5 * (high - low) * math.sin(t)
        (left_1, right_1), (left_2, right_2) = _chord(first, y), _chord(second, y)
        common += max(min(right_1, right_2) - max(left_1, left_2), 0.0) * math.cos(t)
    common *= 0.5 * (high - low) * math.pi / nodes
    return common / (math.pi * (first[2] * first[3] + second[2] * second[3]) - common)


@compiled
def along(ellipse, points, others, linear, corner, patch, away, levels):
    cx, cy, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    held, (pupil, dark) = _holding(ellipse, points, NEAR), levels
    inside, outside = np.empty(SECTORS, dtype=np.float32), np.empty(SECTORS, dtype=np.float32)
    for k in range(SECTORS):
        inside[k] = _beside(ellipse, k, SECTORS, -away[0], linear, corner, patch)
        outside[k] = _beside(ellipse, k, SECTORS, away[0], linear, corner, patch)
    step = float(np.median((outside - inside)[held])) if held.any() else 0.0
    hollow = beyond = within = shaded = pale = mirrored = 0
    for k in range(SECTORS):
        bright = inside[k] > pupil + DARK * step
        if held[k]:
            shaded += outside[k] < pupil + SHADED * step
            pale += bright
        else:
            hollow += inside[k] < dark and outside[k] < dark
            mirrored += bright and outside[k] - inside[k] > DARK * step
    for i in range(others.shape[0]):
        dx, dy = others[i, 0] - cx, others[i, 1] - cy
        p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
        radius, u, v = math.sqrt(p * p + q * q), p / a, q / b
        distance = (radius - 1.0) * radius / max(math.sqrt(u * u + v * v), 1e-12)
        beyond += distance > away[1]
        within += distance < -away[1]
    return hollow, beyond, within, shaded, pale, mirrored


@compiled
def ring_levels(small, blobs, noise, angles):
    n = blobs.shape[0]
    out = np.empty((n, 5))
    near, deep, step = np.empty(angles), np.empty(angles), np.empty(angles)
    within = np.empty(2 * angles)
    turn_cos = np.array([math.cos(2.0 * math.pi * i / angles) for i in range(angles)])
    turn_sin = np.array([math.sin(2.0 * math.pi * i / angles) for i in range(angles)])
    for k in range(n):
        x, y, a, b, angle = blobs[k, 0], blobs[k, 1], blobs[k, 2], blobs[k, 3], blobs[k, 4]
        cos, sin = math.cos(angle), math.sin(angle)
        for i in range(angles):
            p, q = a * turn_cos[i], b * turn_sin[i]
            near[i] = _nearest(small, x + 0.65 * (p * cos - q * sin), y + 0.65 * (p * sin + q * cos))
            deep[i] = _nearest(small, x + 0.4 * (p * cos - q * sin), y + 0.4 * (p * sin + q * cos))
            p, q = (1.15 * a + 1.5) * turn_cos[i], (1.15 * b + 1.5) * turn_sin[i]
            step[i] = _nearest(small, x + p * cos - q * sin, y + p * sin + q * cos) - near[i]
        within[:angles], within[angles:] = near, deep
        typical = np.median(step)
        limit, count = max(0.35 * typical, 2.0 * noise), 0
        for i in range(angles):
            count += step[i] > limit
        out[k, 0], out[k, 1], out[k, 2] = np.median(within), typical, count / angles
        out[k, 3], out[k, 4] = np.median(near), np.std(within)
    return out


@inlined
def _same_blob(first, second):
    near = math.hypot(first[0] - second[0], first[1] - second[1]) < 0.35 * min(first[3], second[3])
    return near and 0.6 < first[2] * first[3] / (second[2] * second[3]) < 1.65


@compiled
def best_blobs(blobs, levels, noise):
    n = blobs.shape[0]
    score, kept, count = np.empty(n), np.empty(MOST_BLOBS, dtype=np.int64), 0
    for i in range(n):
        typical, spread = levels[i, 1], levels[i, 4]
        strength = max(typical, 0.0) / (max(typical, 0.0) + 8.0 * noise + 4.0)
        uniform = 1.0 / (1.0 + (spread / max(typical, 1e-6)) ** 2)
        score[i] = levels[i, 2] ** 2 * strength * uniform * min(blobs[i, 5], 1.0) ** 2
    order = np.argsort(-score, kind="mergesort")
    for i in order:
        new = levels[i, 1] >= max(2.5 * noise, 0.5) and levels[i, 2] >= 0.3
        for k in range(count):
            new = new and not _same_blob(blobs[i], blobs[kept[k]])
        if new:
            kept[count] = i
            count += 1
        if count == MOST_BLOBS:
            break
    final = score[kept[:count]]
    for k in range(count):
        i = kept[k]
        for m in range(count):
            j = kept[m]
            inner = blobs[j, 2] * blobs[j, 3] < 0.6 * blobs[i, 2] * blobs[i, 3]
            inner = inner and math.hypot(blobs[i, 0] - blobs[j, 0], blobs[i, 1] - blobs[j, 1]) < 0.6 * blobs[i, 3]
            darker = levels[i, 3] - levels[j, 3] > max(0.1 * levels[i, 1], 2.0 * noise)
            if inner and darker and levels[j, 2] > 0.55 and levels[j, 1] > 0.12 * levels[i, 1]:
                final[k] = min(final[k], 0.5 * final[m])
    out = np.empty((count, 8))
    for row, k in enumerate(np.argsort(-final, kind="mergesort")):
        out[row, :5], out[row, 5:7], out[row, 7] = blobs[kept[k], :5], levels[kept[k], :2], final[k]
    return out


@inlined
def _box(image, x, y):
    """Mean of the 3 x 3 pixels about a point."""
    height, width, total = image.shape[0], image.shape[1], 0.0
    column, row = int(np.rint(x)), int(np.rint(y))
    for j in range(row - 1, row + 2):
        for i in range(column - 1, column + 2):
            total += image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]
    return total / 9.0


@compiled
def levels_about(linear, ellipse, angles):
    x, y, a, b, angle = ellipse
    cos, sin = math.cos(angle), math.sin(angle)
    within, step = np.empty(2 * angles), np.empty(angles)
    for i in range(angles):
        turn = 2.0 * math.pi * i / angles
        p, q = a * math.cos(turn), b * math.sin(turn)
        u, v = p * cos - q * sin, p * sin + q * cos
        within[i], within[angles + i] = _box(linear, x + 0.65 * u, y + 0.65 * v), _box(linear, x + 0.4 * u, y + 0.4 * v)
        p, q = (1.15 * a + 3.0) * math.cos(turn), (1.15 * b + 3.0) * math.sin(turn)
        step[i] = _box(linear, x + p * cos - q * sin, y + p * sin + q * cos) - within[i]
    return float(np.median(within)), float(np.median(step))


@compiled
def sectors_at(ellipse, x, y, steps):
    out = np.empty(x.size, dtype=np.int64)
    _sectors(ellipse, x, y, steps, out)
    return out
