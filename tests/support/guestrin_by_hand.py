"""Guestrin and Eizenman (2006) written a second time, for eyes of coaxial conics: nothing of the package computes here.

Only numbers come in: the conics, the line of sight in the eye, the places of camera, lights and targets. Rays are found
by Newton with difference quotients; the pupil's centre is that of the direct ellipse (Halir and Flusser 1998); the
corneal centre and the four parameters are those of scipy's least squares.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import fsolve, least_squares


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def turned(azimuth, elevation):
    """Rz(az) Ry(-el) Rx(tau), tau by Listing's law."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    st = -sa * se / (1 + ca * ce)
    ct = np.sqrt(1 - st * st)
    z = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]])
    y = np.array([[ce, 0, -se], [0, 1, 0], [se, 0, ce]])
    return z @ y @ np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])


def met(conic, p, d):
    """Where rays from outside meet y^2 + z^2 + 2 R s + (1 + Q) s^2 = 0 first, and the outward normal there."""
    radius, q, apex = conic
    s = p[:, 0] - apex
    weight = np.array([1 + q, 1.0, 1.0])
    a = np.sum(weight * d * d, axis=1)
    b = p[:, 1] * d[:, 1] + p[:, 2] * d[:, 2] + (radius + (1 + q) * s) * d[:, 0]
    c = p[:, 1] ** 2 + p[:, 2] ** 2 + 2 * radius * s + (1 + q) * s * s
    x = p + ((-b - np.sqrt(b * b - a * c)) / a)[:, None] * d
    return x, unit(np.stack([radius + (1 + q) * (x[:, 0] - apex), x[:, 1], x[:, 2]], axis=1))


def refracted(d, normal, ratio):
    cosine = -np.sum(d * normal, axis=1, keepdims=True)
    return ratio * d + (ratio * cosine - np.sqrt(1 - ratio**2 * (1 - cosine**2))) * normal


def aimed(miss, aim):
    """Newton on two coordinates (n, 2) with difference quotients."""
    for _ in range(5):
        here, h = miss(aim), 1e-5
        slope = np.stack([(miss(aim + h * e) - miss(aim - h * e)) / (2 * h) for e in np.eye(2)], axis=-1)
        aim = aim - np.linalg.solve(slope, here[..., None])[..., 0]
    assert np.abs(miss(aim)).max() < 1e-8
    return aim


def through_cornea(eye, start, aim):
    """Rays from `start` towards (-3, aim): where they are behind the cornea, their direction there, and outside."""
    d = unit(np.column_stack([np.full(len(aim), -3.0), aim]) - start)
    p, way, before = np.broadcast_to(start, d.shape), d, 1.0
    for conic, index in zip(eye["cornea"], eye["indices"], strict=True):
        p, normal = met(conic, p, way)
        way, before = refracted(way, normal, before / index), index
    return p, way, d


def features(eye, camera, lights, motions):
    """Unit rays of the pupil's centre (n, 3) and the glints (n, m, 3) in the world."""
    pupil, glints = [], []
    angle = 2 * np.pi * np.arange(30) / 30
    margin = np.column_stack([np.full(30, -3.6), 2 * np.cos(angle), 2 * np.sin(angle)])
    for m, t in motions:
        place = (camera["place"] - t) @ m

        def miss_stop(aim, place=place):
            p, way, _ = through_cornea(eye, place, aim)
            return (p + ((margin[:, 0] - p[:, 0]) / way[:, 0])[:, None] * way - margin)[:, 1:]

        way = through_cornea(eye, place, aimed(miss_stop, 0.9 * margin[:, 1:]))[2] @ m.T @ camera["R"].T
        centre = ellipse_centre(way[:, 0] / way[:, 2], way[:, 1] / way[:, 2])
        pupil.append(unit(np.array([*centre, 1.0])) @ camera["R"])
        sources = (lights - t) @ m

        def miss_light(aim, place=place, sources=sources):
            d = unit(np.column_stack([np.full(len(aim), -3.0), aim]) - place)
            p, normal = met(eye["cornea"][0], np.broadcast_to(place, d.shape), d)
            way = d - 2 * np.sum(d * normal, axis=1, keepdims=True) * normal
            gap = sources - p
            along = unit(gap)
            first = unit(np.cross(along, [0.0, 0.0, 1.0]))
            return np.stack([np.sum(way * first, axis=1), np.sum(way * np.cross(along, first), axis=1)], axis=1)

        aim = aimed(miss_light, np.zeros((len(lights), 2)))
        glints.append(unit(np.column_stack([np.full(len(aim), -3.0), aim]) - place) @ m.T)
    return np.array(pupil), np.array(glints)


def ellipse_centre(x, y):
    mx, my = x.mean(), y.mean()
    scale = np.hypot(x - mx, y - my).mean()
    x, y = (x - mx) / scale, (y - my) / scale
    d1, d2 = np.stack([x * x, x * y, y * y], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    s2 = d1.T @ d2
    t = -np.linalg.solve(d2.T @ d2, s2.T)
    m = np.array([[0, 0, 0.5], [0, -1, 0], [0.5, 0, 0]]) @ (d1.T @ d1 + s2 @ t)
    vectors = np.linalg.eig(m)[1].real
    a = vectors[:, np.argmax(4 * vectors[0] * vectors[2] - vectors[1] ** 2)]
    f = t @ a
    centre = np.linalg.solve([[2 * a[0], a[1]], [a[1], 2 * a[2]]], -f[:2])
    return mx + scale * centre[0], my + scale * centre[1]


def gaze(parameters, index, camera, lights, pupil, glints, plane):
    """Points (n, 3) on the plane x = `plane` for R, K, alpha, beta."""
    radius, distance, alpha, beta = parameters
    place = camera["place"]

    def centres(k):
        q = place + k.reshape(-1, 2)[..., None] * glints
        return q - radius * unit(unit(lights - q) + unit(place - q))

    k = np.full(glints.shape[:2], np.linalg.norm(place))
    for _ in range(8):  # Gauss-Newton, frame by frame at once
        c, h = centres(k), 1e-3
        apart = c[:, 0] - c[:, 1]
        slopes = []
        for e in ((h, 0.0), (0.0, h)):
            up, down = centres(k + e), centres(k - np.array(e))
            slopes.append((up[:, 0] - up[:, 1] - down[:, 0] + down[:, 1]) / (2 * h))
        j = np.stack(slopes, axis=-1)
        k = k - np.linalg.solve(np.swapaxes(j, 1, 2) @ j, (np.swapaxes(j, 1, 2) @ apart[..., None]))[..., 0]
    c = centres(k).mean(axis=1)
    gap = place - c
    b = np.sum(gap * pupil, axis=1)
    r = place + (-b - np.sqrt(b * b - np.sum(gap * gap, axis=1) + radius**2))[:, None] * pupil
    way = refracted(pupil, (r - c) / radius, 1 / index)
    b = np.sum((r - c) * way, axis=1)
    p = r + (-b - np.sqrt(b * b - radius**2 + distance**2))[:, None] * way
    w = unit(p - c)
    theta, phi = np.arctan2(w[:, 1], w[:, 0]) + np.radians(alpha), np.arcsin(w[:, 2]) + np.radians(beta)
    v = np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=1)
    return c + ((plane - c[:, 0]) / v[:, 0])[:, None] * v


def means_deg(eye, camera, lights, targets, heads, position, plane=650.0, index=1.3375):
    """Mean errors at the first head position, where the four parameters are calibrated, and at the others.

    eye : cornea (radius, conic constant, apex), indices, rotation centre, line of sight (point, direction outward).
    """
    runs = []
    for head in heads:
        motions = []
        for target in targets:
            goal = target - position - head

            def miss(pose, goal=goal):
                m = turned(*pose)
                point = m @ (eye["point"] - eye["centre"]) + eye["centre"]
                return np.cross(goal - point, m @ eye["way"])[1:]

            start = np.arctan2(goal[1:], goal[0]) - np.arctan2(eye["way"][1:], eye["way"][0])
            m = turned(*fsolve(miss, start, xtol=1e-13))
            motions.append((m, eye["centre"] - m @ eye["centre"] + position + head))
        runs.append(features(eye, camera, lights, motions))

    def misses(parameters, run):
        pupil, glints = run
        return gaze(parameters, index, camera, lights, pupil, glints, plane) - targets

    done = least_squares(lambda x: misses(x, runs[0]).ravel(), [7.8, 4.2, 5.0, 1.5], xtol=1e-12, ftol=1e-12, gtol=1e-12)
    errors = []
    for head, run in zip(heads, runs, strict=True):
        origin = position + head
        a, b = unit(misses(done.x, run) + targets - origin), unit(targets - origin)
        errors.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))))
    return float(errors[0].mean()), float(np.mean(errors[1:]))
