"""The compiled functions of the boundary's pixel model (see `compiled`).

Each has the name, arguments and results of its twin, documented there. They are loops over pixels or points.
"""

from __future__ import annotations

import math

import numpy as np

from ..jit import compiled, inlined, summing
from .kernels import BLOCK, NEAR, SECTORS, factored, median_of, places, sector_at, sectors_at, solved

SHAPE, STILL_PX, KURTOSIS = 5, 1.5e-2, (-1.5, 3.0)  # as in covariance and least_squares
OUTLIER, FARTHEST, UNEVEN = 5.0, 3.5, 0.01  # as in occlusion and consensus
_ROOT_HALF = math.sqrt(0.5)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)

# Phi and phi at z = -LAST to LAST in steps of 1 / FINE; a Taylor series of fourth order leads to 1e-11 between them.
FINE, LAST = 32, 8
_STEPS = np.arange(-LAST * FINE, LAST * FINE + 1) / FINE
_PHI = np.array([0.5 * math.erfc(-z * _ROOT_HALF) for z in _STEPS.tolist()])
_BELL = _DENSITY * np.exp(-0.5 * _STEPS**2)


@inlined
def _edges(place, count, sigma, kurtosis, out):
    """`Profile.of` of `count` pixels at a place, as columns of out (7 BLOCK,), one after the other."""
    for i in range(count):
        z, half = min(max(place[i] / sigma, -float(LAST)), float(LAST)), 0.5 * place[5 * BLOCK + i]
        at = int(z * FINE + (LAST * FINE + 0.5))
        near = at * (1.0 / FINE) - LAST
        d, n2, bell, z2 = z - near, near * near, _BELL[at], z * z
        second, third, fourth = 0.5 * (n2 - 1.0), near * (3.0 - n2) / 6.0, (n2 * (n2 - 6.0) + 3.0) / 24.0
        density = bell * (1.0 + d * (-near + d * (second + d * (third + d * fourth))))
        series = 1.0 + d * (-0.5 * near + d * (second / 3.0 + d * (0.25 * third + d * 0.2 * fourth)))
        step, tails = _PHI[at] + bell * d * series, z * (3.0 - z2) * density / 24.0
        bend = density * (1.0 + (kurtosis / 24.0) * (z2 * (z2 - 6.0) + 3.0))
        out[i] = step + half * sigma * density + kurtosis * tails
        out[BLOCK + i] = bend / sigma - half * z * density
        out[2 * BLOCK + i] = half * (1.0 + z2) * density - z * bend / sigma
        out[3 * BLOCK + i], out[4 * BLOCK + i] = tails, place[i] * step + sigma * density
        out[5 * BLOCK + i], out[6 * BLOCK + i] = step, density


@inlined
def _turned(place, count, basis):
    """Turn the harmonics in basis (2 BLOCK,) to the next order."""
    for i in range(count):
        c, s, cu, su = basis[i], basis[BLOCK + i], place[6 * BLOCK + i], place[7 * BLOCK + i]
        basis[i], basis[BLOCK + i] = c * cu - s * su, s * cu + c * su


@inlined
def _outer_levels(place, count, outer, basis, out):
    """Write the outer levels of `count` pixels."""
    out[:count], basis[:count], basis[BLOCK : BLOCK + count] = outer[0], 1.0, 0.0
    for j in range(1, outer.size, 2):
        _turned(place, count, basis)
        for i in range(count):
            out[i] += outer[j] * basis[i] + outer[j + 1] * basis[BLOCK + i]


@compiled
def levels(numbers, displaced, x, y):
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    inner_dn, slope, _, lean_x, lean_y = numbers[6:11]
    place, edge, basis = np.empty(8 * BLOCK), np.empty(7 * BLOCK), np.empty(2 * BLOCK)
    out, outer, n = np.empty(x.size), np.empty(BLOCK), displaced.size
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        places(ellipse, x, y, start, count, 3, place)
        if n:
            for i in range(count):
                at = (math.atan2(place[7 * BLOCK + i], place[6 * BLOCK + i]) / (2.0 * math.pi) + 0.5) * n - 0.5
                low = math.floor(at)
                first = displaced[int(low) % n]
                place[i] += first + (at - low) * (displaced[int(low + 1.0) % n] - first)
        _edges(place, count, numbers[5], numbers[8], edge)
        _outer_levels(place, count, numbers[11:], basis, outer)
        for i in range(count):
            inner = inner_dn + lean_x * place[6 * BLOCK + i] + lean_y * place[7 * BLOCK + i]
            out[start + i] = inner + (outer[i] - inner) * edge[i] + slope * edge[4 * BLOCK + i]
    return out


@inlined
def _rows(place, edge, level, start, count, numbers, basis, rows, residual, steep):
    """Write the slopes of the level by the parameters, the residuals, and the slopes by the distance."""
    cos, sin = math.cos(numbers[4]), math.sin(numbers[4])
    inner_dn, slope, _, lean_x, lean_y = numbers[6:11]
    outer = numbers[11:]
    residual[:count], basis[:count], basis[BLOCK : BLOCK + count] = outer[0], 1.0, 0.0
    for i in range(count):
        rows[11 * BLOCK + i] = edge[i]
    for j in range(1, outer.size, 2):
        _turned(place, count, basis)
        first = (11 + j) * BLOCK
        for i in range(count):
            rows[first + i], rows[first + BLOCK + i] = basis[i] * edge[i], basis[BLOCK + i] * edge[i]
            residual[i] += outer[j] * basis[i] + outer[j + 1] * basis[BLOCK + i]
    for i in range(count):
        cu, su = place[6 * BLOCK + i], place[7 * BLOCK + i]
        inner = inner_dn + lean_x * cu + lean_y * su
        step, within = residual[i] - inner, 1.0 - edge[i]
        steep[i] = step * edge[BLOCK + i] + slope * edge[5 * BLOCK + i]
        residual[i] = level[start + i] - (inner + step * edge[i] + slope * edge[4 * BLOCK + i])
        rows[5 * BLOCK + i] = step * edge[2 * BLOCK + i] + slope * edge[6 * BLOCK + i]
        rows[6 * BLOCK + i], rows[7 * BLOCK + i] = within, edge[4 * BLOCK + i]
        rows[8 * BLOCK + i] = step * edge[3 * BLOCK + i]
        rows[9 * BLOCK + i], rows[10 * BLOCK + i] = within * cu, within * su
    for i in range(count):
        c, s, nx, ny = place[BLOCK + i], place[2 * BLOCK + i], place[3 * BLOCK + i], place[4 * BLOCK + i]
        rows[i], rows[BLOCK + i] = (ny * sin - nx * cos) * steep[i], (-nx * sin - ny * cos) * steep[i]
        rows[2 * BLOCK + i], rows[3 * BLOCK + i] = -nx * c * steep[i], -ny * s * steep[i]
        rows[4 * BLOCK + i] = (-nx * s - ny * c) * steep[i]


@summing
def _add_products(rows, count, out):
    """Add the products of rows (k, n), over the first columns, to the lower half of out (k, k), two by two."""
    even = rows.shape[0] // 2 * 2
    for j in range(0, even, 2):
        for m in range(0, j + 2, 2):
            first = second = third = fourth = 0.0
            for i in range(count):
                first += rows[j, i] * rows[m, i]
                second += rows[j, i] * rows[m + 1, i]
                third += rows[j + 1, i] * rows[m, i]
                fourth += rows[j + 1, i] * rows[m + 1, i]
            out[j, m] += first
            out[j, m + 1] += second
            out[j + 1, m] += third
            out[j + 1, m + 1] += fourth
    for j in range(even, rows.shape[0]):
        for m in range(j + 1):
            total = 0.0
            for i in range(count):
                total += rows[j, i] * rows[m, i]
            out[j, m] += total


@summing
def _add_weighted(rows, begin, end, residual, steep, k, pull, across):
    """Add the sums of rows (p, n), weighted by two values, from `begin` to `end`, to columns k of (p, q)."""
    for j in range(rows.shape[0]):
        first = second = 0.0
        for i in range(begin, end):
            first += rows[j, i] * residual[i]
            second += rows[j, i] * steep[i]
        pull[j, k] += first
        across[j, k] += second


@compiled
def pixel_sums(x, y, level, index, numbers, displaced):
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    sectors, size = displaced.size, numbers.size
    matrix, basis, place, edge = np.zeros((size, size)), np.empty(2 * BLOCK), np.empty(8 * BLOCK), np.empty(7 * BLOCK)
    flat, residual, steep = np.empty(size * BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    rows, pull, across = flat.reshape(size, BLOCK), np.zeros((size, sectors)), np.zeros((size, sectors))
    along, square, cost = np.zeros(sectors), np.zeros(sectors), 0.0
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        places(ellipse, x, y, start, count, NEAR, place)
        for i in range(count):
            place[i] += displaced[index[start + i]]
        _edges(place, count, numbers[5], numbers[8], edge)
        _rows(place, edge, level, start, count, numbers, basis, flat, residual, steep)
        _add_products(rows, count, matrix)
        begin = 0
        while begin < count:  # the pixels of a sector follow each other
            k, end = index[start + begin], begin
            while end < count and index[start + end] == k:
                cost += residual[end] * residual[end]
                along[k] += steep[end] * residual[end]
                square[k] += steep[end] * steep[end]
                end += 1
            _add_weighted(rows, begin, end, residual, steep, k, pull, across)
            begin = end
    for j in range(size):
        for m in range(j):
            matrix[m, j] = matrix[j, m]
    return matrix, cost, pull, across, along, square


@inlined
def _look(x, y, numbers):
    """Sector, distance, curvature, inner level and step of each pixel."""
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    bins, out = np.empty(x.size, dtype=np.int64), np.empty((4, x.size))
    place, basis, outer = np.empty(8 * BLOCK), np.empty(2 * BLOCK), np.empty(BLOCK)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        places(ellipse, x, y, start, count, NEAR, place)
        _outer_levels(place, count, numbers[11:], basis, outer)
        for i in range(count):
            cu, su = place[6 * BLOCK + i], place[7 * BLOCK + i]
            inner = numbers[6] + numbers[9] * cu + numbers[10] * su
            bins[start + i] = sector_at(cu, su)
            out[0, start + i], out[1, start + i] = place[i], place[5 * BLOCK + i]
            out[2, start + i], out[3, start + i] = inner, outer[i] - inner
    return bins, out


@inlined
def _displacements(x, y, level, use, numbers, displaced):
    """`occlusion._displacements`."""
    bins, look = _look(x, y, numbers)
    sigma, slope, n = numbers[5], numbers[7], x.size
    place, edge, residual, steep = np.empty(8 * BLOCK), np.empty(7 * BLOCK), np.empty(n), np.empty(n)
    whole, weight, further = displaced.copy(), np.empty(SECTORS), np.empty(SECTORS)
    for _ in range(2):
        weight[:], further[:] = 0.0, 0.0
        for start in range(0, n, BLOCK):
            count = min(BLOCK, n - start)
            for i in range(count):
                place[i], place[5 * BLOCK + i] = look[0, start + i] + whole[bins[start + i]], look[1, start + i]
            _edges(place, count, sigma, numbers[8], edge)
            for i in range(count):
                step = look[3, start + i]
                steep[start + i] = step * edge[BLOCK + i] + slope * edge[5 * BLOCK + i]
                expected = look[2, start + i] + step * edge[i] + slope * edge[4 * BLOCK + i]
                residual[start + i] = level[start + i] - expected
        for i in range(n):
            if use[i]:
                weight[bins[i]] += steep[i] ** 2
                further[bins[i]] += steep[i] * residual[i]
        largest = 0.0
        for k in range(SECTORS):
            further[k] = min(max(further[k] / weight[k], -sigma), sigma) if weight[k] > 1e-9 else 0.0
            whole[k] += further[k]
            largest = max(largest, abs(further[k]))
        if largest < 0.1 * sigma:
            break
    for i in range(n):
        residual[i] -= steep[i] * further[bins[i]]
    return bins, residual, whole, weight


@compiled
def band(linear, masked, corner, ellipse, outer, inner):
    cx, cy, _, _, angle = ellipse
    cos, sin, reach = math.cos(angle), math.sin(angle), outer[0] + 2.0
    left, top = corner
    x0, x1 = max(left, math.floor(cx - reach)), min(left + linear.shape[1], math.ceil(cx + reach) + 1)
    y0, y1 = max(top, math.floor(cy - reach)), min(top + linear.shape[0], math.ceil(cy + reach) + 1)
    size, n = max(x1 - x0, 0) * max(y1 - y0, 0), 0
    x, y, level = np.empty(size), np.empty(size), np.empty(size)
    for row in range(y0, y1):
        for column in range(x0, x1):
            dx, dy = column - cx, row - cy
            p, q = dx * cos + dy * sin, dy * cos - dx * sin
            if (p / outer[0]) ** 2 + (q / outer[1]) ** 2 >= 1.0 or masked[row - top, column - left]:
                continue
            if (p / inner[0]) ** 2 + (q / inner[1]) ** 2 > 1.0:
                x[n], y[n], level[n] = column, row, linear[row - top, column - left]
                n += 1
    x, y = x[:n].copy(), y[:n].copy()
    return x, y, level[:n].copy(), sectors_at(ellipse, x, y, NEAR)


@compiled
def grouped(x, y, level, bins, use, seen):
    count, first = np.zeros(SECTORS, dtype=np.int64), np.empty(SECTORS, dtype=np.int64)
    for i in range(x.size):
        count[bins[i]] += use[i] and seen[bins[i]]
    sector, rank, n, k = np.empty(SECTORS, dtype=np.int64), np.empty(SECTORS, dtype=np.int64), 0, 0
    for s in range(SECTORS):
        first[s], n = n, n + count[s]
        if count[s]:
            sector[k], rank[s] = s, k
            k += 1
    out, index = np.empty((3, n)), np.empty(n, dtype=np.int64)
    for i in range(x.size):
        s = bins[i]
        if use[i] and seen[s]:
            at = first[s]
            out[0, at], out[1, at], out[2, at], index[at] = x[i], y[i], level[i], rank[s]
            first[s] += 1
    return out[0], out[1], out[2], index, sector[:k].copy()


@inlined
def _normal(sums, displaced, displacement):
    """`Normal.of`: lower half of the matrix, vector, cost, and along and inverse of the sectors."""
    matrix, cost, pull, across, along, square = sums
    vector, taken = np.zeros(matrix.shape[0]), np.zeros(matrix.shape)
    rest, inverse, root = np.zeros(along.size), np.zeros(along.size), np.empty(across.shape)
    if not math.isinf(displacement):
        inverse = 1.0 / (square + displacement)
        rest = along - displacement * displaced
        cost += displacement * np.sum(displaced**2)
        root = across * np.sqrt(inverse)
        _add_products(root, along.size, taken)
    for j in range(vector.size):
        for k in range(along.size):
            vector[j] += pull[j, k] - across[j, k] * inverse[k] * rest[k]
    return matrix - taken, vector, cost, rest, inverse


@inlined
def _held(size, weights):
    """`Prior.of_all`."""
    held = np.zeros(size)
    held[7], held[8], held[9:11], held[12:] = weights[0], weights[1], weights[2], weights[3]
    return held


@inlined
def _stepped(matrix, vector, held, numbers, damping):
    """Damped step of the normal equations with the priors, limited to 3 px, and its largest part before that."""
    size = vector.size
    scale, step = np.empty(size), np.empty(size)
    for j in range(size):
        scale[j] = math.sqrt(max(matrix[j, j] + held[j], 1e-12))
        step[j] = (vector[j] - held[j] * numbers[j]) / scale[j]
    lower = np.empty((size, size))
    for j in range(size):
        for m in range(j):
            lower[j, m] = matrix[j, m] / (scale[j] * scale[m])
        lower[j, j] = (matrix[j, j] + held[j]) / (scale[j] * scale[j]) + damping
    factored(lower)
    solved(lower, step)
    step /= scale
    largest = np.abs(step[:SHAPE]).max()
    if largest > 3.0:
        step *= 3.0 / largest
    return step, largest


@inlined
def _advanced(numbers, step):
    """`moved`, of the numbers of a model."""
    out = numbers + step
    a, b, mixed = out[2], out[3], step[4]
    mean, apart = 0.5 * (a + b), math.sqrt(0.25 * (a - b) ** 2 + mixed * mixed)
    out[2], out[3] = max(mean + apart, 0.5), max(mean - apart, 0.5)
    out[4] = (numbers[4] + 0.5 * math.atan2(2.0 * mixed, a - b)) % math.pi
    out[5] = min(max(out[5], 0.5 * numbers[5], 0.3), max(2.0 * numbers[5], 0.3))
    out[8] = min(max(out[8], KURTOSIS[0]), KURTOSIS[1])
    return out


@compiled
def gauss_newton(x, y, level, index, numbers, displaced, weights, displacement, steps):
    sums = pixel_sums(x, y, level, index, numbers, displaced)
    matrix, vector, cost, along, inverse = _normal(sums, displaced, displacement)
    held, damping = _held(numbers.size, weights), 1e-4
    cost += np.sum(held * numbers**2)
    for _ in range(steps):
        step, largest = _stepped(matrix, vector, held, numbers, damping)
        trial, new_displaced = _advanced(numbers, step), displaced.copy()
        for k in range(along.size):
            further = along[k]
            for j in range(step.size):
                further -= step[j] * sums[3][j, k]
            new_displaced[k] += further * inverse[k]
        if largest < STILL_PX and abs(step[SHAPE]) < 10.0 * STILL_PX and damping < 1e-3:
            return trial, new_displaced, sums
        new_sums = pixel_sums(x, y, level, index, trial, new_displaced)
        new_matrix, new_vector, new_cost, new_along, new_inverse = _normal(new_sums, new_displaced, displacement)
        new_cost += np.sum(held * trial**2)
        if new_cost <= cost:
            numbers, displaced, sums, matrix, vector = trial, new_displaced, new_sums, new_matrix, new_vector
            along, inverse = new_along, new_inverse
            gained, cost = cost - new_cost, new_cost
            damping *= 0.1
            if gained < 1e-7 * cost:
                break
        else:
            damping = min(max(damping * 30.0, 1e-3), 1e6)
    return numbers, displaced, sums


@inlined
def _uneven2(seen, whole, weight, by_noise):
    """Variance of the displacements of the sectors that are seen and told by their pixels, beyond noise."""
    least, n = 0.1 * weight.max(), 0
    size, noise = np.empty(SECTORS), np.empty(SECTORS)
    for k in range(SECTORS):
        if seen[k] and weight[k] > least:
            size[n], noise[n] = abs(whole[k]), by_noise[k]
            n += 1
    if n == 0:
        return 0.0
    return max((1.4826 * median_of(size[:n])) ** 2 - 1.3 * median_of(noise[:n]), 0.0)


@compiled
def visible(x, y, level, use, seen, sectors, numbers, displaced, noise_dn):
    bins, residual, whole, weight = _displacements(x, y, level, use, numbers, displaced)
    by_noise = noise_dn**2 / np.maximum(weight, 1e-9)
    uneven2 = _uneven2(seen, whole, weight, by_noise)
    some, n = np.empty(x.size), 0
    for i in range(x.size):
        if use[i] and seen[bins[i]]:
            some[n] = abs(residual[i])
            n += 1
    scale = max(1.4826 * median_of(some[:n]), noise_dn, 1e-3)
    new_use = np.abs(residual) < OUTLIER * scale
    total, square, outliers = np.zeros(SECTORS), np.zeros(SECTORS), np.zeros(SECTORS)
    for i in range(x.size):
        k = bins[i]
        total[k] += 1.0
        square[k] += min((residual[i] / scale) ** 2, OUTLIER**2)
        outliers[k] += not new_use[i]
    total = np.maximum(total, 1.0)
    square, outliers = square / total, outliers / total
    usual = max(median_of(square[seen]), 1.0)
    explained, likely = np.empty(SECTORS, dtype=np.bool_), np.zeros(SECTORS)
    uneven = (UNEVEN * math.sqrt(numbers[2] * numbers[3])) ** 2
    for k in range(SECTORS):
        often, rarely, far2 = (5.0, 0.25, max(uneven2, uneven)) if sectors[k] else (2.5, 0.1, uneven2)
        explained[k] = square[k] < often * usual and outliers[k] < rarely
        explained[k] = explained[k] and abs(whole[k]) < FARTHEST * math.sqrt(far2 + by_noise[k])
        if explained[k]:
            likely[k] = whole[k] * uneven2 / (uneven2 + by_noise[k])
    return new_use, explained, math.sqrt(uneven2), likely, bins
