"""Monte Carlo simulation of photons in a turbid slab: an oracle that shares no code with the package.

Scattering is isotropic with the reduced coefficient. The surface z = 0 reflects by Fresnel's equations inside. What
reaches the bottom, whose index is matched, comes back diffusely with the share `below`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Photons(NamedTuple):
    """Where photons left the surface, (n,) mm along x, their weights (shares of all), and the share passed on."""

    x: np.ndarray
    weight: np.ndarray
    passed: float

    @property
    def reflectance(self) -> float:
        """Share of the light that came back."""
        return float(self.weight.sum())

    def edge(self, at: np.ndarray) -> np.ndarray:
        """Light at places x (mm) of a surface that is lit where x > 0 only, over that of a surface lit everywhere."""
        order = np.argsort(self.x)
        total = np.cumsum(self.weight[order]) / self.reflectance
        # The problem is symmetric, so both sides count.
        return 0.5 * (np.interp(at, self.x[order], total) + 1 - np.interp(-at, self.x[order], total))


def photons(
    count: int, scattering: float, absorption: float, *, index: float = 1.4, thickness: float = np.inf,
    below: float = 0.0, seed: int = 0,
) -> Photons:  # fmt: skip
    """Simulate photons that enter at the origin along z."""
    rng = np.random.default_rng(seed)
    x = np.zeros((count, 3))
    d = np.tile([0.0, 0.0, 1.0], (count, 1))
    weight = np.ones(count)
    left_x, left_weight, passed = [], [], 0.0
    while len(weight):
        way = rng.exponential(1 / (scattering + absorption), len(weight))
        while True:
            z = x[:, 2] + way * d[:, 2]
            out, down = np.flatnonzero(z < 0), np.flatnonzero(z > thickness)
            if not (len(out) or len(down)):
                break
            step = -x[out, 2] / d[out, 2]
            x[out] += step[:, None] * d[out]
            x[out, 2], way[out] = 0, way[out] - step
            gone = out[rng.random(len(out)) > _inside(-d[out, 2], index)]
            left_x.append(x[gone, 0].copy())
            left_weight.append(weight[gone].copy())
            weight[gone] = way[gone] = 0
            d[out, 2] *= -1
            step = (thickness - x[down, 2]) / d[down, 2]
            x[down] += step[:, None] * d[down]
            x[down, 2], way[down] = thickness, way[down] - step
            gone = down[rng.random(len(down)) >= below]
            passed += weight[gone].sum()
            weight[gone] = way[gone] = 0
            share, turn = rng.random(len(down)), 2 * np.pi * rng.random(len(down))
            r = np.sqrt(share)
            d[down] = np.stack([r * np.cos(turn), r * np.sin(turn), -np.sqrt(1 - share)], axis=1)
        x += way[:, None] * d
        weight *= scattering / (scattering + absorption)
        # Russian roulette
        small = weight < 0.05
        weight = np.where(small, np.where(rng.random(len(weight)) < 0.5, 2 * weight, 0), weight)
        alive = weight > 1e-5
        x, weight = x[alive], weight[alive]
        cosine, turn = 2 * rng.random(len(weight)) - 1, 2 * np.pi * rng.random(len(weight))
        r = np.sqrt(1 - cosine * cosine)
        d = np.stack([r * np.cos(turn), r * np.sin(turn), cosine], axis=1)
    return Photons(np.concatenate(left_x), np.concatenate(left_weight) / count, passed / count)


def _inside(cosine: np.ndarray, index: float) -> np.ndarray:
    """Fresnel reflectance of unpolarised light that meets the surface from inside."""
    sine2 = index**2 * (1 - cosine**2)
    out = np.ones_like(cosine)
    some = sine2 < 1
    a, b = cosine[some], np.sqrt(1 - sine2[some])
    s, p = (index * a - b) / (index * a + b), (a - index * b) / (a + index * b)
    out[some] = 0.5 * (s * s + p * p)
    return out
