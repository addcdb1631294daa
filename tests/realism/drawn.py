"""Drawn pictures of an eye whose figures are known."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, special

from eyerender.apps.realism.figures import EyePicture
from eyerender.optics.ellipse import Ellipse

WIDE, HIGH, CENTRE, R, PUPIL = 640, 512, (320.0, 230.0), 100.0, 38.0
LEVELS = {"pupil": 30.0, "iris": 75.0, "sclera": 100.0, "skin": 160.0}


def distance() -> np.ndarray:
    """Distance (h, w) of every pixel from the eye's centre, px."""
    v, u = np.mgrid[:HIGH, :WIDE]
    return np.hypot(u - CENTRE[0], v - CENTRE[1])


def step(at: np.ndarray, edge: float, sigma: float) -> np.ndarray:
    """Edge of a Gaussian blur: 0 inside, 1 outside; its 10 to 90 % width is 2.563 sigma."""
    return special.ndtr((at - edge) / sigma)


def levels(pupil_sigma: float = 1.5, limbus_sigma: float = 3.0) -> np.ndarray:
    """Levels (h, w) of an eye between straight lids."""
    rho = distance()
    v = np.arange(HIGH)[:, None]
    inside = LEVELS["pupil"] + (LEVELS["iris"] - LEVELS["pupil"]) * step(rho, PUPIL, pupil_sigma)
    eye = inside + (LEVELS["sclera"] - LEVELS["iris"]) * step(rho, R, limbus_sigma)
    lids = np.abs(v - CENTRE[1]) > 1.3 * R
    return np.where(lids, LEVELS["skin"], eye)


def parts() -> np.ndarray:
    """Mask (h, w) of the same eye: sclera out to 1.8 R."""
    rho = distance()
    out = np.where(rho < PUPIL, 3, np.where(rho < R, 2, np.where(rho < 1.8 * R, 1, 0)))
    lids = np.abs(np.arange(HIGH)[:, None] - CENTRE[1]) > 1.3 * R
    return np.where(lids, 0, out).astype(np.uint8)


def picture(codes: np.ndarray, gamma: float = 1.0, labelled: bool = True) -> EyePicture:
    """The picture with its true landmarks."""
    pupil = Ellipse(np.array(CENTRE), np.array([PUPIL, PUPIL]), 0.0)
    mask = parts() if labelled else None
    return EyePicture("drawn", codes.astype(np.float32), gamma, pupil, CENTRE[0], R, mask)


def noise_of_band(shape: tuple[int, int], fine: float, coarse: float, seed: int) -> np.ndarray:
    """Noise that one difference of Gaussians passes, with standard deviation 1 after it."""
    white = np.random.default_rng(seed).normal(size=shape)
    band = ndimage.gaussian_filter(white, fine) - ndimage.gaussian_filter(white, coarse)
    passed = ndimage.gaussian_filter(band, fine) - ndimage.gaussian_filter(band, coarse)
    return band / passed.std()
