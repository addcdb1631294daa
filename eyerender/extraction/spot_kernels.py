"""The compiled functions of the bright spots (see `compiled`).

Each has the name, arguments and results of its twin, documented there. They are loops over pixels or points.
"""

from __future__ import annotations

import math

import numpy as np

from ..jit import compiled, inlined, summing

UNEXPLAINED = 2.0  # as in fitting
# As in gaussian_model.
LOST_PX, STEPS, SMALL_GAIN, ROUGH, ROUGH_SHARE, STALLED = 12.0, 8, (5e-2, 5e-3), 3.0, 0.05, 0.97

_ROOT_HALF = math.sqrt(0.5)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
# As in detection and prescreening.
LEAST_OF_BLOCK, SMOOTH_PX, MAX_SIGMA_PX = 0.5, 0.7, 8.0
MISFIT_OF_HEIGHT, MISFIT_OF_SCATTER, LEAST_PEAK, MOST_CLIPPED = 0.23, 0.70, 0.75, 1
NARROWEST_PX, EXPLAINED, LONGEST, DN = 0.9, 2.0, 2.5, 255.0


@inlined
def _highest(image, y, x):
    """Whether no neighbour of a pixel is brighter."""
    for j in range(max(y - 1, 0), min(y + 2, image.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, image.shape[1])):
            if image[j, i] > image[y, x]:
                return False
    return True


@compiled
def maxima(smooth, half, opened, threshold):
    columns, size, n = half.shape[1], smooth.shape[1], 0
    blocks = np.empty(half.size, dtype=np.int64)
    for y in range(half.shape[0]):
        for x in range(columns):
            if half[y, x] - opened[y, x] > LEAST_OF_BLOCK * threshold:
                blocks[n] = y * columns + x
                n += 1
    flat, height, found = np.empty(4 * n, dtype=np.int64), np.empty(4 * n, dtype=np.float32), 0
    for shift in range(4):
        for k in range(n):
            row, column = blocks[k] // columns, blocks[k] % columns
            y, x = 2 * row + shift // 2, 2 * column + shift % 2
            above = smooth[y, x] - opened[row, column]
            if above > threshold and _highest(smooth, y, x):
                flat[found], height[found] = y * size + x, above
                found += 1
    return flat[:found].copy(), height[:found].copy()


@compiled
def widths(smooth, opened, xy, height, size):
    out = np.empty(height.size)
    for k in range(height.size):
        x, y, area, limit = int(xy[k, 0]), int(xy[k, 1]), 0, np.float32(0.5 * height[k])
        for j in range(max(y - size // 2, 0), min(y + size // 2 + 1, smooth.shape[0])):
            for i in range(max(x - size // 2, 0), min(x + size // 2 + 1, smooth.shape[1])):
                area += smooth[j, i] - opened[j >> 1, i >> 1] > limit
        square = max(area, 1) / (2.0 * math.pi * math.log(2.0)) - SMOOTH_PX**2
        out[k] = min(max(math.sqrt(max(square, 0.3)), 0.5), MAX_SIGMA_PX)
    return out


@inlined
def _level(image, x, y):
    """Level of the pixel nearest to a point."""
    column = int(np.rint(min(max(x, 0.0), image.shape[1] - 1.0)))
    return image[int(np.rint(min(max(y, 0.0), image.shape[0] - 1.0))), column]


@compiled
def compact(smooth, xy, width, height):
    out = np.empty(width.size, dtype=np.bool_)
    for k in range(width.size):
        reach, fallen = 2.5 * width[k] + 1.5, 0
        top = smooth[int(xy[k, 1]), int(xy[k, 0])]
        for i in range(12):
            x, y = reach * math.cos(i * (math.pi / 6.0)), reach * math.sin(i * (math.pi / 6.0))
            fallen += top - _level(smooth, xy[k, 0] + x, xy[k, 1] + y) > 0.33 * height[k]
        out[k] = fallen >= 9
    return out


@compiled
def parted(smooth, xy, size, dip):
    kept, count = np.empty(xy.shape[0], dtype=np.int64), 0
    for i in range(xy.shape[0]):
        alone = True
        for m in range(count):
            k = kept[m]
            if (xy[i, 0] - xy[k, 0]) ** 2 + (xy[i, 1] - xy[k, 1]) ** 2 > size**2:
                continue
            least, first, last = np.float32(np.inf), np.float32(0.0), np.float32(0.0)
            for j in range(2 * size):
                t = j / (2 * size - 1.0)
                last = _level(smooth, xy[i, 0] + t * (xy[k, 0] - xy[i, 0]), xy[i, 1] + t * (xy[k, 1] - xy[i, 1]))
                first = last if j == 0 else first
                least = min(least, last)
            if least >= min(first, last) - dip:
                alone = False
                break
        if alone:
            kept[count] = i
            count += 1
    return kept[:count].copy()


@inlined
def _is_free(xy, disc, outer, k, x, y):
    """Whether a point on the ring of spot k lies in the disc of no other spot."""
    for m in range(disc.size):
        apart2 = (xy[m, 0] - xy[k, 0]) ** 2 + (xy[m, 1] - xy[k, 1]) ** 2
        if 0.0 < apart2 < (outer + disc[m]) ** 2 and (x - xy[m, 0]) ** 2 + (y - xy[m, 1]) ** 2 <= disc[m] ** 2:
            return False
    return True


@compiled
def above_ring(smooth, xy, width):
    angle = np.array([(i % 24 + (i // 24) / 3.0) * (math.pi / 12.0) for i in range(72)])
    ring_cos, ring_sin = np.cos(angle), np.sin(angle)
    out, level, disc = np.full(width.size, np.inf), np.empty(72, dtype=np.float32), 2.5 * width + 1.0
    for k in range(width.size):
        inner, outer, ring, count = 2.2 * width[k] + 1.0, 3.5 * width[k] + 2.0, 0, 0
        for i in range(72):
            radius = inner + (outer - inner) * (0.1 + 0.4 * (i // 24))
            x, y = xy[k, 0] + radius * ring_cos[i], xy[k, 1] + radius * ring_sin[i]
            if -0.5 < x < smooth.shape[1] - 0.5 and -0.5 < y < smooth.shape[0] - 0.5:
                ring += 1
                if _is_free(xy, disc, outer, k, x, y):
                    level[count] = _level(smooth, x, y)
                    count += 1
        if count > 0.25 * ring:
            brightest = np.sort(level[:count])[int(np.rint(0.9 * (count - 1)))]
            out[k] = smooth[int(xy[k, 1]), int(xy[k, 0])] - brightest
    return out


@inlined
def _owns(xy, k, reach, dx, dy):
    """Whether a pixel beside spot k is nearer to it than to any other."""
    for m in range(xy.shape[0]):
        gx, gy = xy[m, 0] - xy[k, 0], xy[m, 1] - xy[k, 1]
        apart2 = gx * gx + gy * gy
        if 0.0 < apart2 < 4.0 * reach * reach and gx * dx + gy * dy > 0.5 * apart2:
            return False
    return True


@inlined
def _patch(linear, xy, k, reach, clip_dn, out):
    """Write the offsets and levels of a spot's own pixels; returns how many, -1 for a clipped spot."""
    half, count, clipped = math.ceil(reach), 0, 0
    x, y = int(xy[k, 0]), int(xy[k, 1])
    for dy in range(-half, half + 1):
        for dx in range(-half, half + 1):
            i, j = x + dx, y + dy
            if dx * dx + dy * dy > reach * reach or not (0 <= i < linear.shape[1] and 0 <= j < linear.shape[0]):
                continue
            if linear[j, i] >= clip_dn:
                clipped += 1
            elif _owns(xy, k, reach, dx, dy):
                out[count, 0], out[count, 1], out[count, 2] = dx, dy, linear[j, i]
                count += 1
    return -1 if clipped > MOST_CLIPPED else count


@inlined
def _stretch(pixels, tall):
    """`prescreening._elongation` of one patch (n, 3)."""
    top, total, x, y, xx, xy, yy = pixels[:, 2].max() - 0.65 * tall, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(pixels.shape[0]):
        dx, dy, weight = pixels[i, 0], pixels[i, 1], max(pixels[i, 2] - top, 0.0)
        total, x, y = total + weight, x + weight * dx, y + weight * dy
        xx, xy, yy = xx + weight * dx * dx, xy + weight * dx * dy, yy + weight * dy * dy
    x, y = x / total, y / total
    xx, xy, yy = xx / total - x * x, xy / total - x * y, yy / total - y * y
    mean, gap = 0.5 * (xx + yy) + 1.0 / 12.0, math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return math.sqrt((mean + gap) / max(mean - gap, 1e-3))


@inlined
def _solve(matrix, vector):
    """Solve by Cholesky's factor; both change, and of the matrix only the lower half counts."""
    n = vector.size
    for j in range(n):
        for m in range(j + 1):
            total = matrix[j, m]
            for i in range(m):
                total -= matrix[j, i] * matrix[m, i]
            matrix[j, m] = math.sqrt(max(total, 1e-300)) if j == m else total / matrix[m, m]
        for i in range(j):
            vector[j] -= matrix[j, i] * vector[i]
        vector[j] /= matrix[j, j]
    for j in range(n - 1, -1, -1):
        for i in range(j + 1, n):
            vector[j] -= matrix[i, j] * vector[i]
        vector[j] /= matrix[j, j]


@inlined
def _bell(pixels, sigma, tall, noise_dn):
    """Whether the levels of a patch (n, 3) form a bell."""
    n, mean = pixels.shape[0], 0.0
    terms, gram = np.empty((n, 8)), np.zeros((8, 8))
    for i in range(n):
        mean += pixels[i, 2] / n
    for i in range(n):
        u, v = pixels[i, 0] / sigma, pixels[i, 1] / sigma
        g = math.exp(-0.5 * (u * u + v * v))
        terms[i, 0], terms[i, 1], terms[i, 2], terms[i, 3] = g, g * u, g * v, g * (u * u + v * v)
        terms[i, 4], terms[i, 5], terms[i, 6], terms[i, 7] = 1.0, u, v, pixels[i, 2] - mean
        for j in range(8):
            for m in range(j + 1):
                gram[j, m] += terms[i, j] * terms[i, m]
    found, square = gram[7, :7].copy(), gram[7, 7]
    for j in range(7):
        gram[j, j] += 1e-6
    _solve(gram, found)
    cost = 0.0
    for i in range(n):
        left = -terms[i, 7]
        for j in range(7):
            left += found[j] * terms[i, j]
        cost += left * left
    misfit, scatter = math.sqrt(cost / n), math.sqrt(square / n)
    good = misfit < MISFIT_OF_HEIGHT * min(tall, DN) and misfit < MISFIT_OF_SCATTER * scatter
    good = (good and found[0] > LEAST_PEAK * tall) or misfit <= EXPLAINED * noise_dn
    return good and _stretch(pixels, tall) <= LONGEST


@compiled
def bells(linear, xy, width, height, noise_dn, clip_dn, index):
    out = np.ones(index.size, dtype=np.bool_)
    for m in range(index.size):
        k = index[m]
        sigma = max(width[k], NARROWEST_PX)
        reach = 2.2 * sigma + 1.0
        pixels = np.empty(((2 * math.ceil(reach) + 1) ** 2, 3))
        count = _patch(linear, xy, k, reach, clip_dn, pixels)
        if count >= 12:
            out[m] = _bell(pixels[:count], sigma, height[k], noise_dn)
    return out


@compiled
def windows(linear, start, centre, radius):
    n, size = radius.size, 0
    for k in range(n):
        size += (2 * math.ceil(radius[k] + 0.5) + 1) ** 2
    first, spot = np.zeros(n + 1, dtype=np.int64), np.empty(size, dtype=np.int64)
    plane, data, count = np.empty((3, size)), np.empty(size), 0
    for k in range(n):
        half = math.ceil(radius[k] + 0.5)
        off_x, off_y, square = centre[k, 0] - start[k, 0], centre[k, 1] - start[k, 1], radius[k] ** 2
        for dy in range(-half, half + 1):
            for dx in range(-half, half + 1):
                x, y = int(centre[k, 0]) + dx, int(centre[k, 1]) + dy
                if (off_y + dy) ** 2 + (off_x + dx) ** 2 > square:
                    continue
                if 0 <= x < linear.shape[1] and 0 <= y < linear.shape[0]:
                    spot[count], plane[1, count], plane[2, count], data[count] = k, dx, dy, linear[y, x]
                    count += 1
        first[k + 1] = count
    plane[0] = 1.0
    return first, spot[:count].copy(), plane[:, :count].copy(), data[:count].copy()


@inlined
def _bright_moments(plane, begin, end, rest, level, out):
    """Write the second moments (2, 2) of the part of a spot's pixels above a third of their height over a level."""
    top = 0.0
    for i in range(begin, end):
        top = max(top, rest[i] - level)
    total = x = y = xx = xy = yy = 0.0
    for i in range(begin, end):
        weight, dx, dy = max(rest[i] - level - 0.35 * top, 0.0), plane[1, i], plane[2, i]
        total, x, y = total + weight, x + weight * dx, y + weight * dy
        xx, xy, yy = xx + weight * dx * dx, xy + weight * dx * dy, yy + weight * dy * dy
    total = max(total, 1e-12)
    x, y = x / total, y / total
    out[0, 0], out[1, 1] = xx / total - x * x, yy / total - y * y
    out[0, 1] = out[1, 0] = xy / total - x * y


@compiled
def reported(first, plane, centre, theta, gram, used, rest, noise, penalty, blur_px):
    n, k = theta.shape
    covariance, moments, level, misfit = np.empty((n, 2, 2)), np.zeros((n, 2, 2)), np.empty(n), np.empty(n)
    ridge = 1e-9 * np.eye(k)
    for s in range(n):
        own, pull = theta[s], 0.0
        for j in range(k):
            for m in range(k):
                pull += own[j] * penalty[j, m] * own[m]
        cost = max(gram[s, k, k] - pull, 0.0)
        inverse, scale = np.linalg.inv(gram[s, :k, :k] + ridge), max(cost / max(used[s] - k, 1.0), 1.0)
        covariance[s] = inverse[:2, :2] * scale
        x, y = own[0] - centre[s, 0], own[1] - centre[s, 1]
        level[s] = own[5] + own[6] * x + own[7] * y
        if k > 8:
            t = (x * math.cos(own[9]) + y * math.sin(own[9]) - own[10]) / blur_px
            level[s] += own[8] * 0.5 * math.erfc(-t * _ROOT_HALF)
        misfit[s] = math.sqrt(cost / max(used[s], 1.0)) * noise
        moments[s, 0, 0], moments[s, 1, 1] = math.exp(2.0 * own[3]), math.exp(2.0 * own[4])
        if misfit[s] > UNEXPLAINED * noise:
            _bright_moments(plane, first[s], first[s + 1], rest, level[s], moments[s])
    return covariance, level, misfit, moments


@inlined
def _profile(low, sigma, out):
    """`windows.profile` of one pixel from `low` to `low` + 1 (from the centre): by the centre, value, by ln sigma."""
    first, last = low / sigma, (low + 1.0) / sigma
    tail_first, tail_last = math.exp(-0.5 * first * first), math.exp(-0.5 * last * last)
    value = sigma * math.sqrt(0.5 * math.pi) * (math.erf(last * _ROOT_HALF) - math.erf(first * _ROOT_HALF))
    out[0], out[1] = tail_first - tail_last, value
    out[2] = value + sigma * (first * tail_first - last * tail_last)


@compiled
def spot_rows(first, plane, centre, radius, theta, rest, blur_px):
    n, size = theta.shape
    out = np.empty((size + 1, rest.size))
    for k in range(n):
        half = math.ceil(radius[k] + 0.5)
        across, along = np.empty((2 * half + 1, 3)), np.empty((2 * half + 1, 3))
        x, y, height = theta[k, 0] - centre[k, 0], theta[k, 1] - centre[k, 1], math.exp(theta[k, 2])
        wide, high = math.exp(theta[k, 3]), math.exp(theta[k, 4])
        for j in range(2 * half + 1):
            _profile(j - half - 0.5 - x, wide, across[j])
            _profile(j - half - 0.5 - y, high, along[j])
        for i in range(first[k], first[k + 1]):
            dx, dy = plane[1, i], plane[2, i]
            p, q = across[int(dx) + half], along[int(dy) + half]
            light = height * p[1] * q[1]
            out[0, i], out[1, i], out[2, i] = height * p[0] * q[1], height * p[1] * q[0], light
            out[3, i], out[4, i] = height * p[2] * q[1], height * p[1] * q[2]
            out[5, i], out[6, i], out[7, i] = 1.0, dx, dy
            left = rest[i] - light - theta[k, 5] - theta[k, 6] * dx - theta[k, 7] * dy
            if size > 8:
                cos, sin = math.cos(theta[k, 9]), math.sin(theta[k, 9])
                t = (dx * cos + dy * sin - theta[k, 10]) / blur_px
                bell = theta[k, 8] * (_DENSITY / blur_px) * math.exp(-0.5 * t * t)
                out[8, i] = 0.5 * math.erfc(-t * _ROOT_HALF)
                out[9, i], out[10, i] = bell * (dy * cos - dx * sin), -bell
                left -= theta[k, 8] * out[8, i]
            out[size, i] = left
    return out


@summing
def _add_products(rows, begin, end, out):
    """Add the products of rows (k, n), over the columns from `begin` to `end`, to the lower half of out (k, k)."""
    for j in range(rows.shape[0]):
        for m in range(j + 1):
            total = 0.0
            for i in range(begin, end):
                total += rows[j, i] * rows[m, i]
            out[j, m] += total


@compiled
def covered(linear, clip_dn, xy, radius):
    height, width = linear.shape
    mask = np.empty(linear.shape, dtype=np.bool_)
    for y in range(height):
        for x in range(width):
            mask[y, x] = linear[y, x] >= clip_dn
    for k in range(radius.size):
        for y in range(max(0, math.floor(xy[k, 1] - radius[k])), min(height, math.ceil(xy[k, 1] + radius[k]) + 1)):
            for x in range(max(0, math.floor(xy[k, 0] - radius[k])), min(width, math.ceil(xy[k, 0] + radius[k]) + 1)):
                mask[y, x] |= (x - xy[k, 0]) ** 2 + (y - xy[k, 1]) ** 2 < radius[k] ** 2
    return mask


@compiled
def subtracted(linear, spots, radius, limit):
    height, width = linear.shape
    out, bright, whole = linear.copy(), np.zeros(linear.shape, dtype=np.bool_), np.empty(3)
    for k in range(radius.size):
        x0, x1 = max(0, math.floor(spots[k, 0] - radius[k])), min(width, math.ceil(spots[k, 0] + radius[k]) + 1)
        y0, y1 = max(0, math.floor(spots[k, 1] - radius[k])), min(height, math.ceil(spots[k, 1] + radius[k]) + 1)
        across = np.empty(max(x1 - x0, 0))
        for x in range(x0, x1):
            _profile(x - 0.5 - spots[k, 0], spots[k, 2], whole)
            across[x - x0] = whole[1] * spots[k, 4]
        for y in range(y0, y1):
            _profile(y - 0.5 - spots[k, 1], spots[k, 3], whole)
            for x in range(x0, x1):
                light = across[x - x0] * whole[1]
                out[y, x] -= np.float32(light)
                bright[y, x] |= light > limit
    return out, bright


@inlined
def _weighed(first, rows, clip, theta, noise, penalty, gram, used):
    """`gaussian_model._gram`: write the products with the priors, and how many pixels count."""
    n, k = theta.shape
    for i in range(clip.size):
        if clip[i] and rows[k, i] <= 0.0:
            rows[:, i] = 0.0
    gram[:] = 0.0
    for s in range(n):
        used[s] = first[s + 1] - first[s]
        for i in range(first[s], min(first[s + 1], clip.size)):
            used[s] -= clip[i] and rows[5, i] == 0.0
        _add_products(rows, first[s], first[s + 1], gram[s])
        for j in range(k + 1):
            for m in range(j + 1):
                gram[s, j, m] /= noise * noise
                gram[s, m, j] = gram[s, j, m]
        for j in range(k):
            pull = 0.0
            for m in range(k):
                gram[s, j, m] += penalty[j, m]
                pull += theta[s, m] * penalty[m, j]
            gram[s, j, k] -= pull
            gram[s, k, k] += pull * theta[s, j]


@inlined
def _light(first, plane, centre, radius, theta, pairs, out):
    """Light of other spots in every spot's pixels; pairs (m, 2) of a window and the spot that shines into it."""
    out[:] = 0.0
    for i in range(pairs.shape[0]):
        to, by = pairs[i]
        half = math.ceil(radius[to] + 0.5)
        across, along, whole = np.empty(2 * half + 1), np.empty(2 * half + 1), np.empty(3)
        x, y, height = theta[by, 0] - centre[to, 0], theta[by, 1] - centre[to, 1], math.exp(theta[by, 2])
        wide, high = math.exp(theta[by, 3]), math.exp(theta[by, 4])
        for j in range(2 * half + 1):
            _profile(j - half - 0.5 - x, wide, whole)
            across[j] = height * whole[1]
            _profile(j - half - 0.5 - y, high, whole)
            along[j] = whole[1]
        for j in range(first[to], first[to + 1]):
            out[j] += across[int(plane[1, j]) + half] * along[int(plane[2, j]) + half]


@inlined
def _lost(theta, start):
    wide = max(theta[3], theta[4]) > math.log(LOST_PX)
    return wide or (theta[0] - start[0]) ** 2 + (theta[1] - start[1]) ** 2 > LOST_PX**2


@inlined
def _promising(theta, cost, used, noise):
    return noise * math.sqrt(cost / max(used, 1.0)) < max(ROUGH * noise, ROUGH_SHARE * math.exp(theta[2]))


@inlined
def _dim(first, rows, gram, light, noise):
    """`gaussian_model._dimmed`."""
    n, k = gram.shape[0], gram.shape[1] - 1
    for s in range(n):
        square = taken = 0.0
        for i in range(first[s], first[s + 1]):
            square += (light[i] * rows[5, i]) ** 2
        for j in range(k + 1):
            taken = 0.0
            for i in range(first[s], first[s + 1]):
                taken += rows[j, i] * light[i] * rows[5, i]
            gram[s, j, k] -= taken / noise**2
        gram[s, k, k] += (square - taken) / noise**2


@inlined
def _accept(small, trial, theta):
    for s in range(theta.shape[0]):
        if small[s].all():
            theta[s] = trial[s]


@inlined
def _ended(theta, middle, gram, cost):
    """How far each spot moved, and whether its squared misfit halved."""
    n, k = theta.shape
    moved, falling = np.empty(n), np.empty(n, np.bool_)
    for s in range(n):
        moved[s] = max(abs(theta[s, 0] - middle[s, 0]), abs(theta[s, 1] - middle[s, 1]))
        falling[s] = gram[s, k, k] < 0.5 * cost[s]
    return moved, falling


@inlined
def _tried(gram, damping, theta, bounds, step, trial):
    """Write the damped step of one spot and where it leads; returns the gain that it promises."""
    k, gain = theta.size, 0.0
    matrix = gram[:k, :k].copy()
    for j in range(k):
        matrix[j, j] = matrix[j, j] * (1.0 + damping) + 1e-9
        step[j] = gram[j, k]
    _solve(matrix, step)
    for j in range(k):
        gain += step[j] * gram[j, k]
        step[j] = min(max(step[j], -bounds[2, j]), bounds[2, j])
        trial[j] = min(max(theta[j] + step[j], bounds[0, j]), bounds[1, j])
    return gain


@inlined
def _dimmed(windows, theta, rows, pairs, better, held, rest, gram, noise):
    """Subtract the change of the other spots' light from the residuals and the products."""
    first, plane, centre, radius = windows
    light = np.empty(rest.size)
    _light(first, plane, centre, radius, theta, pairs, light)
    for s in range(theta.shape[0]):
        for i in range(first[s], first[s + 1]):
            light[i] = (light[i] - held[i]) * better[s]
            held[i] += light[i]
            rest[i] -= light[i]
    _dim(first, rows, gram, light, noise)


@compiled
def descended(windows, theta, rest, clip, pairs, noise, penalty, blur_px, steps, bounds):
    first, plane, centre, radius = windows
    n, k = theta.shape
    rest, theta, start, middle = rest.copy(), theta.copy(), theta[:, :2].copy(), theta[:, :2].copy()
    gram, new, used, new_used = np.empty((n, k + 1, k + 1)), np.empty((n, k + 1, k + 1)), np.empty(n), np.empty(n)
    rows = spot_rows(first, plane, centre, radius, theta, rest, blur_px)
    _weighed(first, rows, clip, theta, noise, penalty, gram, used)
    damping, cost = np.full(n, 1e-2), np.full(n, np.inf)
    over, stalled, better = np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    held, shared = np.zeros(rest.size), pairs.shape[0] > 0
    _light(first, plane, centre, radius, theta, pairs, held)
    enough = SMALL_GAIN[1] if shared else SMALL_GAIN[0]
    step, trial = np.empty((n, k)), np.empty((n, k))
    for turn in range(steps):
        late, ended = turn >= STEPS // 2, True
        for s in range(n):
            gain = _tried(gram[s], damping[s], theta[s], bounds, step[s], trial[s])
            over[s] = gain < enough * max(gram[s, k, k] / max(used[s], 1.0), 1.0)
            over[s] = over[s] or (late and (damping[s] > 1e5 or _lost(theta[s], start[s])))
            stalled[s] = stalled[s] and not (late and _promising(theta[s], gram[s, k, k], used[s], noise))
            ended = ended and (over[s] or (late and stalled[s]))
        if ended:
            _accept(np.abs(step) < 1.0, trial, theta)
            break
        rows = spot_rows(first, plane, centre, radius, trial, rest, blur_px)
        _weighed(first, rows, clip, trial, noise, penalty, new, new_used)
        for s in range(n):
            better[s] = new[s, k, k] <= gram[s, k, k] * (1.0 + 1e-12)
            stalled[s] = better[s] and new[s, k, k] > STALLED * gram[s, k, k]
            damping[s] = max(0.1 * damping[s], 1e-7) if better[s] else 8.0 * damping[s]
            if better[s]:
                theta[s], gram[s], used[s] = trial[s], new[s], new_used[s]
        if shared and turn % 2 == 1:
            _dimmed(windows, theta, rows, pairs, better, held, rest, gram, noise)
        if turn + 1 == steps // 2:
            middle[:] = theta[:, :2]
            cost[:] = gram[:, k, k]
    moved, falling = _ended(theta, middle, gram, cost)
    return theta, gram, used, over, moved, falling
