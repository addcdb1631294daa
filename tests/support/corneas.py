"""Corneas for tests: one of a published eye, irregular ones, and conics as expansions and as grids."""

from __future__ import annotations

from typing import Any

import numpy as np

from eyerender.eye.catalogue import load_eye
from eyerender.eye.parts import GridSpec, ZernikeSpec
from eyerender.eye.spec import EyeSpec
from eyerender.optics.surfaces_measured import fitted

# The anterior cornea of the eye in the tests of visisipy (MIT; SyntEyes: Rozema et al. 2016, IOVS 57:683), order 8,
# depths in mm on a disc of radius 3.25 mm.
GOLDEN = (
    0.3422905828606648, 0.0005918084373896628, 0.0023131431725943166, -0.00026351564081592986, 0.20051898573989937,
    -0.0036612315961836056, -2.428312266595696e-05, -2.403927691334431e-05, 0.0007059334156698186,
    8.864882939898646e-05, -3.399424117941327e-05, 8.885714895108974e-05, 0.002205550520562905, -7.855216001463333e-05,
    -1.570505384349936e-05, -0.00011860854680563971, 7.492497484619524e-05, -6.127651225517059e-05,
    -6.55477451291802e-05, -3.4991858402204235e-05, -1.6868186800315804e-05, 2.5741322252816072e-05,
    4.901106964583404e-05, -5.096535805866357e-05, -3.9409960234172464e-05, 4.943626529619928e-06,
    -3.811789111786062e-05, 1.0715046827191875e-05, 1.0653441793748403e-05, 4.491498417045251e-06,
    -3.17763488862075e-06, -1.3484088178570585e-05, -1.443594172053776e-05, -4.3937376170334406e-07,
    -1.8896076192723605e-05, 2.698192488406551e-05, 2.8013263484274167e-06, -1.5441741759154541e-06,
    -7.583533435122606e-06, 3.2177202266793137e-06, -7.496554199440541e-06, 7.089090609435584e-07,
    1.1694068125761121e-06, -2.871193221796745e-07, -4.8178166331526814e-06,
)  # fmt: skip
GOLDEN_RADIUS_MM = 3.25
# Its posterior cornea, and the front of its lens (order 5, on a disc of radius 2.75 mm).
GOLDEN_BACK = (
    0.4254098029065651, 0.015151346008161745, 0.018716241236515236, -0.002894571446253507, 0.250772958674681,
    -0.011569367232794078, -0.0009947693901929176, 0.00022967864181157226, 0.00048430334933299737,
    0.0002774616744770464, 0.00034391399192934937, -0.0005131691127042454, 0.003691528043749198,
    0.0004634316392532736, 0.0011127376473646887, -0.00016148197805108445, 0.00035905472032638213,
    -0.0007099801172671901, -0.0005867594542743903, 0.00010592876505913449, -0.0001703067033983096,
    0.00011447790844218325, -0.0001259526428822465, -6.580569413489336e-06, -0.0003706205185427817,
    -0.00012813756330976966, -0.0002749176617622146, -6.703428212847885e-05, 1.583961893100351e-05,
    2.4513525025958863e-05, -3.570775549361546e-05, 3.95203845374714e-05, 2.883462212720441e-05,
    -2.712484730862813e-05, 2.7836245784241974e-05, 8.260450815834121e-05, -9.890194981402716e-06,
    -8.479011050954407e-06, 4.102549733188398e-06, 1.4873684209678047e-05, 3.411734090933008e-05,
    2.4265943253665817e-05, 3.189073233104356e-05, 1.6333071387751156e-06, -2.8446899809450242e-05,
)  # fmt: skip
GOLDEN_LENS = (
    0.0, 0.0, 0.0, 0.0, -0.003, 0.0025, -0.0005, 0.0011, 0.0009, -8e-05, 0.0007, -0.00035, -0.0023, 0.0004, 0.00027,
    0.00015, 0.00025, -0.00025, 0.0001, 0.0001, 0.0001,
)  # fmt: skip


def conic_depth(y: Any, z: Any, radius_mm: float = 7.8, conic_constant: float = -0.25) -> Any:
    """Depth of a conic below its apex."""
    square = np.asarray(y) ** 2 + np.asarray(z) ** 2
    return square / radius_mm / (1.0 + np.sqrt(1.0 - (1.0 + conic_constant) * square / radius_mm**2))


def cone(y: Any, z: Any, height_mm: float = 0.03, sigma_mm: float = 1.2, at: tuple[float, float] = (-0.8, -1.0)) -> Any:
    """Gaussian cone of a keratoconus."""
    return height_mm * np.exp(-((np.asarray(y) - at[0]) ** 2 + (np.asarray(z) - at[1]) ** 2) / (2.0 * sigma_mm**2))


def zernike_of(depth: Any, radius_mm: float, order: int, **keys: Any) -> ZernikeSpec:
    """Least-squares expansion of a depth (a function of y, z) on a disc."""
    place = np.linspace(-1.0, 1.0, 61)
    p, q = (a[np.hypot(*np.meshgrid(place, place)) <= 1.0] for a in np.meshgrid(place, place))
    coefficients = fitted(order, p, q, depth(radius_mm * p, radius_mm * q))
    return ZernikeSpec(kind="zernike", radius_mm=radius_mm, coefficients_mm=tuple(coefficients), **keys)


def grid_of(depth: Any, half_mm: float = 5.75, spacing_mm: float = 0.25, **keys: Any) -> GridSpec:
    """Heights of a depth (a function of y, z) on a grid."""
    count = round(half_mm / spacing_mm)
    y, z = np.meshgrid(*[spacing_mm * np.arange(-count, count + 1)] * 2)
    return GridSpec(kind="grid", spacing_mm=spacing_mm, heights_mm=-depth(y, z), **keys)


def keratoconus(y: Any, z: Any) -> Any:
    """Depth of a conic with a cone."""
    return conic_depth(y, z) - cone(y, z)


def measured_shapes() -> dict[str, ZernikeSpec | GridSpec]:
    """Measured shapes of every kind."""
    ripple = np.random.default_rng(5).normal(size=66) * 2e-4
    return {
        "zernike": ZernikeSpec(kind="zernike", radius_mm=GOLDEN_RADIUS_MM, coefficients_mm=GOLDEN),
        "zernike on a conic": ZernikeSpec(
            kind="zernike",
            radius_mm=4.5,
            base_radius_mm=7.7,
            base_conic_constant=-0.2,
            coefficients_mm=tuple(ripple / np.arange(1, 67)),
        ),
        "zernike lens back": ZernikeSpec(
            kind="zernike",
            radius_mm=3.0,
            base_radius_mm=-6.0,
            base_conic_constant=-1.0,
            coefficients_mm=(0.0, 0.0, 0.0, 0.0, 1e-3),
        ),
        "grid": grid_of(keratoconus),
    }


def eye_with(front: ZernikeSpec | GridSpec | None, back: ZernikeSpec | GridSpec | None = None) -> EyeSpec:
    """E4 with another front cornea (and back cornea)."""
    data = load_eye("E4").to_mapping()
    for k, shape in enumerate((front, back)):
        if shape is not None:
            data["cornea"][k]["shape"] = shape.to_mapping()
    return EyeSpec.from_mapping(data)
