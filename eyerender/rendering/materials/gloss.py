"""Gloss of skin and wet tissue: films of oil and tears, whose roughness shapes their highlights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

_F0_OIL, _F0_TEARS = 0.035, 0.0202  # reflectance at normal incidence (n 1.46 and 1.331)
_ROUGH_OIL, _THINNER = 0.13, 0.35  # roughness of a film of oil at a gloss of 0.5, and how much it grows per gloss below
# Water that stands on tissue is smooth. A film follows the tissue, whose bumps are much finer than a pixel: the
# roughness grows by `_BARER` per gloss below that of standing water.
_ROUGH_WET, _STANDING, _BARER, _ROUGHEST = 0.02, 0.97, 3.2, 0.15
_WATER = 0.92  # gloss of tears without oil; with gloss 1, they mirror as much as a layer of oil (index 1.48)
_RIPPLE_MM, _GLOBE_MM, _ROUGH_RIPPLES = 1.9, 12.0, 0.012  # of a rippled film: waves, the globe's radius, roughness
_CALM_MM = (5.6, 7.2)  # distance from the optic axis over which the smooth film of the cornea gets its ripples
_RIPPLES = ((0.05, 0.3), (0.015, 1.0))  # slopes of wet tissue, and waves to those 1 mm long on the globe


def sheen(normal: mi.Vector3f, to_lamp: mi.Vector3f, to_camera: mi.Vector3f, gloss: mi.Float) -> mi.Float:
    """Compute the specular BRDF f (1/sr) of skin (gloss below 0.5) or wet tissue (above), about a `glossy_normal`.

        f = w D F / (4 (l . h)^2),  D = a^2 / (pi ((n . h)^2 (a^2 - 1) + 1)^2)

    with h half way between lamp and camera (GGX: Walter et al. 2007; the visibility term: Kelemen, Szirmay-Kalos 2001;
    F: Schlick 1994). The roughness a represents structure finer than a pixel: only standing water is smooth, and
    thinner films are rougher. Oil on tears, at a gloss above `_WATER`, reflects more.
    """
    wet = gloss > 0.5
    half = dr.normalize(to_lamp + to_camera)
    lh = dr.maximum(dr.dot(to_lamp, half), 0.05)
    nh = dr.maximum(dr.dot(normal, half), 0)
    water = (2 * gloss - 1) * (1 + 10 * dr.maximum(gloss - _WATER, 0))
    weight = dr.select(wet, water, gloss * (1 / 0.45))
    film = dr.clip(_ROUGH_WET + _BARER * (_STANDING - gloss), _ROUGH_WET, _ROUGHEST)
    D = _ggx(nh, dr.select(wet, film, _ROUGH_OIL + _THINNER * (0.5 - gloss)))
    return weight * D * _schlick(lh, dr.select(wet, _F0_TEARS, _F0_OIL)) * 0.25 / (lh * lh)


def _ggx(nh: mi.Float, a: mi.Float) -> mi.Float:
    """Compute the distribution D (1/sr) of the normals of a surface of roughness a."""
    a2 = a * a
    base = nh * nh * (a2 - 1) + 1
    return a2 * dr.inv_pi / (base * base)


def glossy_normal(normal: mi.Vector3f, gloss: mi.Float) -> mi.Vector3f:
    """Compute the normal (eye frame) of the mirroring surface: skin itself, or the tear film on wet tissue."""
    return dr.select(gloss > 0.5, film_normal(normal), normal)


def film_normal(normal: mi.Vector3f) -> mi.Vector3f:
    """Compute the normal of the tear film (eye frame); the uneven conjunctiva below it breaks up its highlights."""
    tilted = normal
    for slope, wave in _RIPPLES:
        p, q = wave * (71 * normal.y + 23 * normal.z), wave * (67 * normal.z - 29 * normal.y)
        tilted = tilted + slope * mi.Vector3f(0, dr.sin(p + 1.7 * dr.sin(q)), dr.sin(q + 1.7 * dr.sin(p)))
    return dr.normalize(tilted)


def rippled_film(normal: mi.Vector3f, slope: mi.Float, pixel_mm: mi.Float) -> tuple[mi.Vector3f, mi.Float]:
    """Compute normal (eye frame) and gloss of a smooth tear film on a globe with ripples of this slope.

    Each ripple mirrors a lamp once, so the picture shows rows of points: compact ones, as the slope varies by much more
    than the roughness. The film is smooth in patches, and as rough as the tissue between them. Within a pixel of
    `pixel_mm`, the ripples only add to the roughness.
    """
    wave = 2 * dr.pi / _RIPPLE_MM
    p0, q0 = (wave * _GLOBE_MM * (a * normal.y + b * normal.z) for a, b in ((0.35, 0.94), (0.64, -0.29)))
    tilt = mi.Vector2f(0)
    for part, shorter in ((1.0, 1.0), (0.7, 1.7)):
        # Slow waves bend the rows and move the points of each against those of the next.
        p, q = shorter * p0, shorter * q0
        along = dr.sin(q + 1.3 * dr.sin(0.61 * p) + 2 * dr.sin(0.23 * p))
        across = dr.sin(p + 1.7 * dr.sin(0.53 * q) + 2 * dr.sin(0.19 * q))
        tilt += part * mi.Vector2f(along, across)
    blur = slope * wave * pixel_mm * 0.29  # standard deviation over a pixel is its width / sqrt(12)
    smooth = dr.minimum(dr.sqrt(_ROUGH_RIPPLES * _ROUGH_RIPPLES + blur * blur), _ROUGHEST)
    patch = dr.sin(0.53 * p0 + 2 * dr.sin(0.29 * q0)) * dr.sin(0.46 * q0 + 2 * dr.sin(0.36 * p0))
    rough = dr.lerp(_ROUGHEST, smooth, dr.clip(3 * patch + 0.8, 0, 1))
    gloss = _STANDING - (rough - _ROUGH_WET) * (1 / _BARER)
    off = _GLOBE_MM * dr.sqrt(normal.y * normal.y + normal.z * normal.z)
    slope = slope * dr.clip((off - _CALM_MM[0]) / (_CALM_MM[1] - _CALM_MM[0]), 0, 1)
    return dr.normalize(normal + slope * mi.Vector3f(0, tilt.x, tilt.y)), gloss


def film_reflectance(cosine: mi.Float, gloss: mi.Float) -> mi.Float:
    """Compute the share of light from wide surroundings that the film on wet tissue mirrors."""
    return (2 * gloss - 1) * _schlick(dr.clip(cosine, 0, 1), mi.Float(_F0_TEARS))


def _schlick(cosine: mi.Float, f0: mi.Float) -> mi.Float:
    s = 1 - cosine
    s2 = s * s
    return f0 + (1 - f0) * s2 * s2 * s
