"""Choose the best k of n positions for LEDs, by greedy exchange on the information that they add.

Glints add up: with the information B_i of outline and priors in frame i and G_ik of the glint of LED k, the LEDs S have

    f(S) = mean over frames of log det (B_i + sum over S of G_ik)                                                  (8)

which is submodular, so greedily adding the best LED is near-optimal, and exchanging single LEDs improves it further
(Fedorov's exchange; Nemhauser, Wolsey and Fisher 1978). Two choices differ by the factor exp((f - f') / (2 p)) in the
geometric mean of the standard deviations of p parameters, whatever their units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..base.arrays import ArrayValue, Floats, Ints
from ..base.errors import InputError
from ..rig.rig import RigLike
from ..scene import Frames, Scene
from .information import case_of, whitened_slopes
from .noise import FeatureNoise, sensor_noise
from .unknowns import COUNT, Unknowns
from .varied import FeatureSlopes, slopes_of

VAGUE = 1e-6
"""Precision of unknown numbers, per rad^2 or mm^2, so that frames without features have a determinant."""
_POINTS = 16


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SiteInformation(ArrayValue):
    """Information that each LED adds in i frames, on q unknown parameters.

    Attributes:
        base: (i, q, q) information of the outline and priors.
        sites: (m, i, q, q) information of each LED's glint, 0 where there is none.
    """

    base: Floats
    sites: Floats

    def value(self, chosen: tuple[int, ...]) -> float:
        """Compute the mean log determinant of the information with these LEDs, equation (8)."""
        return float(np.linalg.slogdet(self.base + self.sites[list(chosen)].sum(axis=0))[1].mean())

    def worse_by(self, chosen: tuple[int, ...], best: tuple[int, ...]) -> float:
        """Compute the ratio of the geometric-mean standard deviations of two choices; 1 if equally good."""
        return float(np.exp((self.value(best) - self.value(chosen)) / (2.0 * self.base.shape[-1])))


def site_information(
    frames: Frames, rig: RigLike | None = None, *, unknowns: Unknowns | None = None, noise: FeatureNoise | None = None
) -> SiteInformation:
    """Compute the information that each LED of a rig adds in each frame; see `er.information` for the arguments.

    Each frame is treated separately, with the priors of its person; all cameras of an instant count.

    >>> scene = er.load_scene("headset")
    >>> er.design.site_information(scene.frames()).sites.shape[0]
    8
    """
    case, _ = case_of(frames, rig)
    scene = frames.scene if rig is None else frames.seen_by(rig).scene
    noise = sensor_noise(scene) if noise is None else noise
    views = case.views
    unknowns = Unknowns.population() if unknowns is None else unknowns
    slopes = slopes_of(views, case.theta[case.instant], _POINTS, unknowns.free())
    base, sites = site_matrices(slopes, noise, views.camera)
    count = len(case.theta)
    outlines, glints = np.zeros((count, COUNT, COUNT)), np.zeros((count, len(sites), COUNT, COUNT))
    np.add.at(outlines, case.instant, base)
    np.add.at(glints, case.instant, np.moveaxis(sites, 0, 1))
    return with_priors(outlines, np.moveaxis(glints, 1, 0), unknowns)


def noise_of_some(scene: Scene, count: int) -> FeatureNoise:
    """Compute the feature noise with only `count` of a scene's LEDs on: less light on the iris, the same glints.

    >>> er.design.noise_of_some(er.load_scene("headset"), 4).glint_px.shape
    (1, 8)
    """
    dimmer = [
        replace(light, intensity_mw_sr=light.intensity_mw_sr * count / len(scene.rig.lights))
        for light in scene.rig.lights
    ]
    some = sensor_noise(scene, lights=tuple(dimmer))
    return replace(some, glint_px=sensor_noise(scene).glint_px)


def site_matrices(slopes: FeatureSlopes, noise: FeatureNoise, camera: Ints) -> tuple[Floats, Floats]:
    """Compute information in each of n views: (n, 35, 35) of the outline and (m, n, 35, 35) of each LED's glint."""
    across, glints = whitened_slopes(slopes, noise, camera)
    glints = np.moveaxis(glints, 1, 0)
    return np.swapaxes(across, -1, -2) @ across, np.swapaxes(glints, -1, -2) @ glints


def with_priors(base: Floats, sites: Floats, unknowns: Unknowns) -> SiteInformation:
    """Add the priors once, and remove known parameters."""
    free = np.flatnonzero(unknowns.free())
    base = base + np.diag(np.maximum(unknowns.precision(), VAGUE))
    return SiteInformation(base=base[:, free[:, None], free], sites=sites[:, :, free[:, None], free])


def joined(parts: list[SiteInformation]) -> SiteInformation:
    """Join frames of different people."""
    return SiteInformation(
        base=np.concatenate([part.base for part in parts]), sites=np.concatenate([part.sites for part in parts], axis=1)
    )


def choose_lights(known: SiteInformation, count: int) -> tuple[int, ...]:
    """Choose LEDs: add the best one repeatedly, then exchange single LEDs while that improves the choice.

    >>> known = er.design.site_information(er.load_scene("headset").frames())
    >>> er.design.choose_lights(known, 4)
    (0, 2, 5, 6)

    Args:
        known: information that each LED adds.
        count: number of LEDs to choose.

    Returns:
        Their numbers, ascending.

    Raises:
        InputError: `count` is below 1 or above the number of LEDs.
    """
    n = len(known.sites)
    if not 1 <= count <= n:
        raise InputError(f"must be 1 to {n}, the number of places, not {count}", path="count")
    chosen: tuple[int, ...] = ()
    while len(chosen) < count:
        chosen = max(((*chosen, k) for k in range(n) if k not in chosen), key=known.value)
    best = known.value(chosen)
    while True:
        swaps = [(*(k for k in chosen if k != out), new) for out in chosen for new in range(n) if new not in chosen]
        other = max(swaps, key=known.value, default=chosen)
        value = known.value(other)
        if value <= best + 1e-12 * abs(best):
            return tuple(sorted(chosen))
        chosen, best = other, value
