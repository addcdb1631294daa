"""Lens distortion: the models of OpenCV, and their inverse.

A model maps coordinates (x, y) of a direction to (x'', y'') on the sensor, in units of the focal length. For pinhole
lenses x = X/Z, y = Y/Z; for a fisheye (x, y) = theta (X, Y) / |(X, Y)|, with theta the angle from the optical axis.

    five numbers:  x'' = x g + 2 p1 x y + p2 (r^2 + 2 x^2),   g = 1 + k1 r^2 + k2 r^4 + k3 r^6,   r^2 = x^2 + y^2
    rational:      the same with g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    fisheye:       x' = x g, g = 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8;   x'' = x' + 2 p1 x' y' + p2 (r'^2 + 2 x'^2)

and alike for y, with p1 and p2 exchanged. Source: OpenCV's documentation of calib3d and cv2.fisheye (the fisheye is the
model of Kannala and Brandt 2006, eq. 6); the p of the fisheye are not OpenCV's, but those of headset makers.

The functions work on arrays of NumPy and of Dr.Jit. They take the coefficients `k` of a model as one sequence, whose
length tells the model: 5 for k1, k2, p1, p2, k3; 8 for these and k4, k5, k6; 6 for k1, k2, k3, k4, p1, p2 of a fisheye.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Discriminator, Field, Tag

from ..base.arrays import Floats, frozen
from ..base.spec import Number, Spec
from ..base.storage.files import shown

FISHEYE_COUNT, RATIONAL_COUNT = 6, 8
POLYNOMIAL = 9  # coefficients of `ray_polynomials`
FARTHEST_RAD = float(np.radians(110.0))
"""Largest angle from the axis of a fisheye's rays; the polynomials of wider lenses are not measured beyond."""


class FisheyeDistortion(Spec):
    """OpenCV's fisheye (equidistant) model, with two tangential terms."""

    model: Literal["fisheye"] = Field(description="the model")
    k: tuple[Number, Number, Number, Number] = Field(description="k1, k2, k3, k4 of `cv2.fisheye`")
    p: tuple[Number, Number] = Field(default=(0.0, 0.0), description="p1, p2, tangential terms of headset makers")


class RationalDistortion(Spec):
    """OpenCV's rational model: k1, k2, p1, p2, k3, k4, k5, k6."""

    model: Literal["rational"] = Field(description="the model")
    coefficients: tuple[Number, Number, Number, Number, Number, Number, Number, Number] = Field(
        description="k1, k2, p1, p2, k3, k4, k5, k6 of OpenCV"
    )


_FORMS = (
    "the five numbers [k1, k2, p1, p2, k3], {model: fisheye, k: [k1, k2, k3, k4]} or "
    "{model: rational, coefficients: [k1, k2, p1, p2, k3, k4, k5, k6]}"
)


def _checked(value: object) -> object:
    """Refuse what has none of the forms; pydantic's own message would list the errors of every form."""
    if isinstance(value, Mapping) and _form(value) in ("[fisheye]", "[rational]"):
        return {key: tuple(one) if isinstance(one, list) else one for key, one in value.items()}
    if isinstance(value, FisheyeDistortion | RationalDistortion):
        return value
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 5:
        raise ValueError(f"must be {_FORMS}, not {shown(value)}")
    return tuple(value)


def _form(value: object) -> str:
    model = value.get("model") if isinstance(value, Mapping) else getattr(value, "model", None)
    return f"[{model}]" if model is not None else "[five]"


Distortion = Annotated[
    Annotated[tuple[Number, Number, Number, Number, Number], Tag("[five]")]
    | Annotated[FisheyeDistortion, Tag("[fisheye]")]
    | Annotated[RationalDistortion, Tag("[rational]")],
    Discriminator(_form),
    BeforeValidator(_checked),
]
"""A distortion as a person writes it."""


def coefficients_of(distortion: Any) -> Floats:
    """Return the coefficients (5,), (6,) or (8,) of a distortion in an authored form, as JSON, or as coefficients."""
    given = distortion.to_mapping() if isinstance(distortion, Spec) else distortion
    if isinstance(given, Mapping):
        given = (
            given["coefficients"] if given["model"] == "rational" else (*given["k"], *(given.get("p") or (0.0, 0.0)))
        )
    return frozen(given)


def distortion_data(k: ArrayLike) -> Any:
    """Return coefficients in the form of scenes and JSON: a list of five, or a mapping with the model."""
    values = np.asarray(k, dtype=float).tolist()
    if len(values) == FISHEYE_COUNT:
        return {"model": "fisheye", "k": values[:4], "p": values[4:]}
    return {"model": "rational", "coefficients": values} if len(values) == RATIONAL_COUNT else values


def is_fisheye(k: Sequence[Any] | Floats) -> bool:
    """Return whether coefficients are those of a fisheye."""
    return len(k) == FISHEYE_COUNT


def is_distorted(k: Sequence[Any] | Floats) -> bool:
    """Return whether a lens with these coefficients differs from a pinhole."""
    return is_fisheye(k) or bool(np.any(k))


def distort(x: Any, y: Any, k: Sequence[Any] | Floats) -> tuple[Any, Any]:
    """Apply the distortion: (x, y) to (x'', y'')."""
    r2 = x * x + y * y
    radial, _, (p1, p2) = _radial(r2, k)
    xr, yr = x * radial, y * radial
    if is_fisheye(k):
        x, y, r2 = xr, yr, xr * xr + yr * yr
    return (xr + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), yr + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


def _radial(r2: Any, k: Sequence[Any] | Floats) -> tuple[Any, Any, tuple[Any, Any]]:
    """Compute the radial factor g, its derivative with respect to r^2, and the tangential coefficients."""
    if is_fisheye(k):
        k1, k2, k3, k4, p1, p2 = k
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        return radial, k1 + r2 * (2 * k2 + r2 * (3 * k3 + 4 * k4 * r2)), (p1, p2)
    k1, k2, p1, p2, k3 = k[:5]
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
    if len(k) == RATIONAL_COUNT:
        k4, k5, k6 = k[5:]
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = radial / below
        slope = (slope - radial * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / below
    return radial, slope, (p1, p2)


def distortion_jacobian(x: Any, y: Any, k: Sequence[Any] | Floats) -> tuple[Any, Any, Any, Any]:
    """Compute the Jacobian of `distort`: dx''/dx, dx''/dy, dy''/dx, dy''/dy."""
    radial, slope, (p1, p2) = _radial(x * x + y * y, k)
    a, b, d = radial + 2 * x * x * slope, 2 * x * y * slope, radial + 2 * y * y * slope
    if not is_fisheye(k):
        b = b + 2 * p1 * x + 2 * p2 * y
        return a + 2 * p1 * y + 6 * p2 * x, b, b, d + 6 * p1 * y + 2 * p2 * x
    x, y = x * radial, y * radial
    e, g, h = 1 + 2 * p1 * y + 6 * p2 * x, 2 * p1 * x + 2 * p2 * y, 1 + 6 * p1 * y + 2 * p2 * x
    return e * a + g * b, e * b + g * d, g * a + h * b, g * b + h * d


def distorted_area(x: Any, y: Any, k: Sequence[Any] | Floats) -> Any:
    """Compute the determinant D of `distortion_jacobian`: area on the sensor per area without distortion."""
    a, b, c, d = distortion_jacobian(x, y, k)
    return a * d - b * c


def is_imaged(x: Any, y: Any, k: Sequence[Any] | Floats) -> Any:
    """Return whether the lens images (x, y): it has not folded the image back, and a fisheye's ray is not too far off.

    Without a fold both eigenvalues of the Jacobian are positive.
    """
    a, b, c, d = distortion_jacobian(x, y, k)
    imaged = (a + d > 0) & (a * d - b * c > 0)
    return imaged & (x * x + y * y <= FARTHEST_RAD**2) if is_fisheye(k) else imaged


def newton_step(x: Any, y: Any, xd: Any, yd: Any, k: Sequence[Any] | Floats) -> tuple[Any, Any]:
    """Compute the Newton step of `undistort` from (x, y) towards the distorted (xd, yd); subtract it from (x, y)."""
    fx, fy = distort(x, y, k)
    ex, ey = fx - xd, fy - yd
    a, b, c, d = distortion_jacobian(x, y, k)
    det = a * d - b * c
    return (d * ex - b * ey) / det, (a * ey - c * ex) / det


def undistort(xd: Floats, yd: Floats, k: Floats, iterations: int = 50) -> tuple[Floats, Floats]:
    """Invert `distort` by Newton's method on its exact Jacobian; NaN where it does not converge."""
    x, y = xd.copy(), yd.copy()
    for _ in range(iterations):
        dx, dy = newton_step(x, y, xd, yd, k)
        x, y = x - dx, y - dy
        if np.nanmax(np.hypot(dx, dy), initial=0.0) < 1e-15:
            break
    fx, fy = distort(x, y, k)
    bad = ~(np.hypot(fx - xd, fy - yd) < 1e-12)
    if is_fisheye(k):
        bad |= np.hypot(x, y) > FARTHEST_RAD
    return np.where(bad, np.nan, x), np.where(bad, np.nan, y)


@lru_cache(maxsize=16)  # a camera has the same in every frame
def fold_radius(k: tuple[float, ...], most: float = np.inf) -> tuple[float, float]:
    """Compute the radius beyond which the radial part of a lens images nothing, without and with distortion.

    There r g(r^2) has its first maximum or pole; inf if it has none. A lens ends at the radius `most` at the latest,
    and a fisheye at `FARTHEST_RAD`.
    """
    if is_fisheye(k):
        above, below = np.array([1.0, *k[:4]]), np.ones(1)
    else:
        above, below = np.array([1.0, k[0], k[1], k[4]]), np.array([1.0, *k[5:]])
    # With s = r^2 and g = n / m, the derivative of r g is ((n + 2 s n') m - 2 s n m') / m^2.
    n, m = np.polynomial.Polynomial(above), np.polynomial.Polynomial(below)
    s = np.polynomial.Polynomial([0.0, 1.0])
    found = np.concatenate([((n + 2 * s * n.deriv()) * m - 2 * s * n * m.deriv()).roots(), m.roots()])
    r2 = float(found.real[(np.abs(found.imag) < 1e-12) & (found.real > 0)].min(initial=np.inf))
    reach = min(r2**0.5, most, FARTHEST_RAD if is_fisheye(k) else np.inf)
    if reach == np.inf:
        return np.inf, np.inf
    with np.errstate(divide="ignore"):
        return reach, abs(reach * float(n(reach**2) / m(reach**2)))


@lru_cache(maxsize=16)
def ray_polynomials(k: tuple[float, ...], corner: float) -> tuple[float, ...]:
    """Fit the rays of a fisheye: sin(theta) / theta_d, cos(theta) and d theta / d theta_d over theta_d^2.

    Returns:
        The coefficients (3 x `POLYNOMIAL`,), the constant ones first, and the largest theta_d^2: that of `corner`, the
        farthest radius of the sensor, or of the fold. Nothing if single precision would miss the functions by 1e-6.
    """
    t = fold_radius(k)[0] * np.sin(np.linspace(1e-6, np.pi / 2, 2000))
    growth = sum((1.0, *k[:4])[n] * t ** (2 * n) for n in range(5))
    inside = t * growth <= corner
    t, radius = t[inside], (t * growth)[inside]
    slope = sum((2 * n + 1) * (1.0, *k[:4])[n] * t ** (2 * n) for n in range(5))
    out, s = [], radius**2
    with np.errstate(divide="ignore"):
        wanted = np.sin(t) / radius, np.cos(t), 1 / slope
    for values in wanted:
        fit = np.polynomial.Polynomial.fit(s, np.minimum(values, 1e6), POLYNOMIAL - 1).convert().coef
        single, found = s.astype(np.float32), np.zeros(len(s), np.float32)
        for one in fit[::-1]:
            found = np.float32(one) + single * found
        if not np.max(np.abs(found - values)) < 1e-6:
            return ()
        out += np.pad(fit, (0, POLYNOMIAL - len(fit))).tolist()
    return (*out, float(s[-1]))
