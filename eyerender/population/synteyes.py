"""SyntEyes: a statistical eye model with corneas as Zernike terms, from the user's own file of its numbers.

Rozema, Rodriguez, Navarro and Tassignon (2016), "SyntEyes: a higher-order statistical eye model for healthy eyes", IOVS
57:683-691. The file is `modeldata.npz` as visisipy distributes it. A vector of 18 numbers is drawn from one of two
Gaussians, chosen by its weight: depth of the chamber behind the cornea, thickness of the lens, axial length, the lens'
radii, its power, and 12 weights of eigencorneas. These become 45 Zernike terms of either side of the cornea (order 8,
in mm on a disc of 6.5 mm) and its thickness. The retina is an ellipsoid, drawn given the axial length.

The model knows no limbus, iris, pupil centre, centres of rotation or fovea; they are arguments with defaults.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import ArrayValue, Floats
from ..base.errors import InputError
from ..base.spec import LARGEST, SMALLEST
from ..base.storage.files import read_bytes
from ..eye.kappa import with_kappa
from ..eye.spec import EyeSpec
from ..optics.transforms import read_only

CORNEA_INDEX, AQUEOUS_INDEX, VITREOUS_INDEX = 1.376, 1.336, 1.336
RETINA_THICKNESS_MM = 0.2
CORNEA_RADIUS_MM, LENS_RADIUS_MM = 3.25, 2.75
LENS_FRONT_Q, LENS_BACK_Q = -3.1316, -1.0
MAX_FILE_BYTES, MAX_ARRAY_BYTES = 16 * 2**20, 2**20
MAX_REFUSED = 100
"""Largest number of impossible draws of one subject."""
_SHAPES: dict[str, tuple[int, ...]] = {
    "conv_ec_orig": (91, 12),
    "avg_ec_orig": (91,),
    "weights_orig": (2,),
    "mu_orig": (2, 18),
    "cov_orig0": (18, 18),
    "cov_orig1": (18, 18),
    "mu_retina_radii": (4,),
    "cov_retina_radii": (4, 4),
}
_LENS_TERMS = "lens_za_orig"
# Emmetropic centres of rotation (Fry and Hill 1962, 1963) at this length; half a mm for each mm of length (Dick 1990).
_EMMETROPIC_MM, _AZIMUTH_MM, _ELEVATION_MM, _PER_MM = 23.58, 14.7, 12.0, 0.5
_ROOT_GAP_MM, _LIMBUS_GAP_MM = 0.1, 0.3


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SyntEye(ArrayValue):
    """One drawn eye.

    Attributes:
        chamber_depth_mm: from the BACK of the cornea to the lens.
        lens_thickness_mm: thickness of the lens.
        axial_length_mm: from the front of the cornea to the back of the retina.
        lens_radii_mm: (2,) radii of front (> 0) and back (< 0).
        lens_power_d: power of the lens in the aqueous.
        cornea_mm: (2, 45) Zernike terms of front and back.
        thickness_mm: thickness of the cornea.
        retina_mm: (3,) semi-axes of the retina: horizontal, vertical, axial.
        component: number of the Gaussian that it is drawn from.
        refused: number of impossible draws before this one.
    """

    chamber_depth_mm: float
    lens_thickness_mm: float
    axial_length_mm: float
    lens_radii_mm: Floats
    lens_power_d: float
    cornea_mm: Floats
    thickness_mm: float
    retina_mm: Floats
    component: int = 0
    refused: int = 0

    @property
    def lens_index(self) -> float:
        """Equivalent index of the lens, from its power by the thick-lens formula.

        P = F1 + F2 - (d / n) F1 F2 with F1 = (n - n_a) / R1 and F2 = (n_v - n) / R2 is a quadratic in n.
        """
        (r1, r2), d, power = self.lens_radii_mm, self.lens_thickness_mm, self.lens_power_d / 1000.0
        a, v = AQUEOUS_INDEX, VITREOUS_INDEX
        # n P = n F1 + n F2 - d F1 F2, gathered by powers of n.
        with np.errstate(all="ignore"):
            square = 1.0 / r1 - 1.0 / r2 + d / (r1 * r2)
            linear = -a / r1 + v / r2 - d * (a + v) / (r1 * r2) - power
            constant = d * a * v / (r1 * r2)
        if not np.isfinite([square, linear, constant]).all():  # a radius of 0
            return float("nan")
        roots = np.roots([square, linear, constant])
        real = roots[np.isreal(roots)].real
        return float(real[np.argmin(np.abs(real - 1.42))]) if len(real) else float("nan")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SyntEyes(ArrayValue):
    """The statistical model.

    Attributes:
        weights: (2,) weights of the Gaussians.
        means: (2, 18) their means.
        factors: (2, 18, 18) F with F F^T the covariance, whose negative eigenvalues are 0.
        corneas: (91, 12) contribution of the eigencorneas to the terms and the thickness, um.
        mean_cornea: (91,) mean terms and thickness, mm.
        lens_mm: (k,) Zernike terms of the lens' front.
        retina_mean: (4,) mean of the axial length without the retina, and of its semi-axes.
        retina_covariance: (4, 4) covariance of these.
    """

    weights: Floats
    means: Floats
    factors: Floats
    corneas: Floats
    mean_cornea: Floats
    lens_mm: Floats
    retina_mean: Floats
    retina_covariance: Floats

    @classmethod
    def load(cls, path: str | Path) -> SyntEyes:
        """Read the model's file; InputError if the file is of another kind."""
        arrays = _arrays(path)
        for name, shape in _SHAPES.items():
            if name == "avg_ec_orig":
                arrays[name] = arrays[name].reshape(-1)
            if arrays[name].shape != shape:
                raise InputError(f"must have the shape {shape}, not {arrays[name].shape}", source=str(path), path=name)
        weights = arrays["weights_orig"]
        if (weights < 0.0).any() or not 0.99 < weights.sum() < 1.01:
            raise InputError("must be shares whose sum is 1", source=str(path), path="weights_orig")
        if arrays["cov_retina_radii"][0, 0] < SMALLEST:
            raise InputError("must have a variance > 0 of the axial length", source=str(path), path="cov_retina_radii")
        factors = np.stack([_factor(arrays[name]) for name in ("cov_orig0", "cov_orig1")])
        lens = arrays[_LENS_TERMS].reshape(-1)
        return cls(
            weights=read_only(weights / weights.sum()),
            means=read_only(arrays["mu_orig"]),
            factors=read_only(factors),
            corneas=read_only(arrays["conv_ec_orig"]),
            mean_cornea=read_only(arrays["avg_ec_orig"]),
            lens_mm=read_only(lens[:28]),
            retina_mean=read_only(arrays["mu_retina_radii"]),
            retina_covariance=read_only(arrays["cov_retina_radii"]),
        )

    def draw(self, subject: int, seed: int = 0, **keys: Any) -> tuple[SyntEye, EyeSpec]:
        """Draw the eye of a subject, a pure function of (seed, subject), and return it with its eye file.

        Impossible draws (surfaces that cross, a stop outside the chamber) are repeated.

        Args:
            subject: number of the subject.
            seed: seed of the population.
            keys: see `eye_file`.

        Raises:
            InputError: a hundred draws were impossible.
        """
        for refused in range(MAX_REFUSED):
            rng = np.random.default_rng([seed, subject, refused])
            found = self._drawn(rng, refused)
            try:
                return found, self.eye_file(found, name=f"SyntEyes {seed}/{subject}", **keys)
            except InputError as error:
                last = error
        raise InputError(f"subject {subject}: {MAX_REFUSED} draws were not possible eyes; the last one: {last}")

    def _drawn(self, rng: np.random.Generator, refused: int) -> SyntEye:
        # The weighted sum of two draws, one of each component, would have the mixture's mean but too small a spread.
        component = int(rng.uniform() >= self.weights[0])
        latent = self.means[component] + self.factors[component] @ rng.normal(size=18)
        return self.of_latent(latent, rng.normal(size=3), component, refused)

    def of_latent(self, latent: Floats, retina_score: Floats, component: int = 0, refused: int = 0) -> SyntEye:
        """Create the eye of a latent vector (18,); `retina_score` (3,) are standard normal numbers of the retina."""
        terms = self.mean_cornea + 1e-3 * (self.corneas @ latent[6:])
        mean, covariance = self.retina_mean, self.retina_covariance
        slope = covariance[1:, 0] / covariance[0, 0]
        left = _factor(covariance[1:, 1:] - np.outer(slope, covariance[0, 1:]))
        given = latent[2] - RETINA_THICKNESS_MM - mean[0]
        return SyntEye(
            chamber_depth_mm=float(latent[0]),
            lens_thickness_mm=float(latent[1]),
            axial_length_mm=float(latent[2]),
            lens_radii_mm=read_only([latent[3], latent[4]]),
            lens_power_d=float(latent[5]),
            cornea_mm=read_only(terms[:90].reshape(2, 45)),
            thickness_mm=float(terms[90]),
            retina_mm=read_only(mean[1:] + slope * given + left @ retina_score),
            component=component,
            refused=refused,
        )

    def eye_file(
        self,
        eye: SyntEye,
        *,
        name: str = "SyntEyes",
        pupil_diameter_mm: float = 4.0,
        limbus_radius_mm: float = 5.85,
        sclera_radius_mm: float = 12.0,
        alpha_deg: tuple[float, float] = (5.45, 2.5),
        kappa_deg: tuple[float, float] | None = None,
    ) -> EyeSpec:
        """Return the eye file of a drawn eye.

        Args:
            eye: the drawn eye.
            name: name of the eye.
            pupil_diameter_mm: diameter of the stop, which lies at the lens' front.
            limbus_radius_mm: half of the visible diameter of the iris.
            sclera_radius_mm: radius of the sclera.
            alpha_deg: field direction of the fovea from the optic axis, nasal and up.
            kappa_deg: angle from the pupillary axis to the line of sight; replaces alpha, which is then found by
                tracing.

        Raises:
            InputError: the numbers do not make a possible eye.
        """
        lens = eye.thickness_mm + eye.chamber_depth_mm
        front, back = (tuple(float(c) for c in row) for row in eye.cornea_mm)
        horizontal, vertical, axial = (float(v) for v in eye.retina_mm)
        if min(horizontal, vertical, axial) <= 0.0:
            raise InputError("must be > 0", path="retina.shape.semi_axes_mm")
        turn = _PER_MM * (eye.axial_length_mm - _EMMETROPIC_MM)
        spec = EyeSpec.from_mapping(
            {
                "name": name,
                "description": "An eye of SyntEyes (Rozema et al. 2016)",
                "cornea": [
                    {"name": "anterior cornea", "shape": _cornea(front), "medium": {"index": CORNEA_INDEX}},
                    {
                        "name": "posterior cornea",
                        "shape": _cornea(back),
                        "position_mm": [-eye.thickness_mm, 0.0, 0.0],
                        "medium": {"index": AQUEOUS_INDEX},
                    },
                ],
                "lens": {
                    "kind": "surfaces",
                    "surfaces": [
                        {
                            "name": "lens front",
                            "shape": {
                                "kind": "zernike",
                                "radius_mm": LENS_RADIUS_MM,
                                "coefficients_mm": [float(c) for c in self.lens_mm],
                                "base_radius_mm": float(eye.lens_radii_mm[0]),
                                "base_conic_constant": LENS_FRONT_Q,
                            },
                            "position_mm": [-lens, 0.0, 0.0],
                            "medium": {"index": eye.lens_index},
                        },
                        {
                            "name": "lens back",
                            "shape": {
                                "kind": "conic",
                                "radius_mm": float(eye.lens_radii_mm[1]),
                                "conic_constant": LENS_BACK_Q,
                            },
                            "position_mm": [-lens - eye.lens_thickness_mm, 0.0, 0.0],
                            "medium": {"index": VITREOUS_INDEX},
                        },
                    ],
                },
                "retina": {
                    "shape": {"kind": "ellipsoid", "semi_axes_mm": [axial, horizontal, vertical], "side": "back"},
                    "position_mm": [-(eye.axial_length_mm - RETINA_THICKNESS_MM), 0.0, 0.0],
                },
                "stop": {"diameter_mm": pupil_diameter_mm, "position_mm": [-lens, 0.0, 0.0]},
                "limbus_radius_mm": limbus_radius_mm,
                "iris": {"root_radius_mm": _iris_root(eye, limbus_radius_mm)},
                "sclera": {"radius_mm": sclera_radius_mm},
                "rotation": {
                    "azimuth_centre_mm": [-(_AZIMUTH_MM + turn), 0.0, 0.0],
                    "elevation_centre_mm": [-(_ELEVATION_MM + turn), 0.0, 0.0],
                },
                "fovea": {"field_deg": list(alpha_deg)},
            }
        )
        return spec if kappa_deg is None else with_kappa(spec, kappa_deg)


def _cornea(terms: tuple[float, ...]) -> dict[str, Any]:
    return {"kind": "zernike", "radius_mm": CORNEA_RADIUS_MM, "coefficients_mm": list(terms)}


def _iris_root(eye: SyntEye, limbus_mm: float) -> float:
    """Compute the radius of the iris' root: just inside the posterior cornea, taken as a sphere of its mean radius."""
    # The curvature of c_4 Z_4 + c_12 Z_12 at the apex, over the disc's radius.
    back = eye.cornea_mm[1]
    bend = 2.0 * (2.0 * np.sqrt(3.0) * back[4] - 6.0 * np.sqrt(5.0) * back[12]) / CORNEA_RADIUS_MM**2
    depth = eye.chamber_depth_mm
    reach = np.sqrt(max(2.0 * depth / bend - depth**2, 0.0)) if bend > 0.0 else 0.0
    return float(min(limbus_mm - _LIMBUS_GAP_MM, max(reach - _ROOT_GAP_MM, 0.1)))


def _arrays(path: str | Path) -> dict[str, Floats]:
    """Return the arrays of the file by name."""
    source = str(path)
    data = read_bytes(path, limit=MAX_FILE_BYTES)
    names = (*_SHAPES, _LENS_TERMS)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
        missing = [name for name in names if f"{name}.npy" not in sizes]
        if missing:
            raise InputError(f"has no array {missing[0]!r}; is it the modeldata.npz of visisipy?", source=source)
        if max(sizes[f"{name}.npy"] for name in names) > MAX_ARRAY_BYTES:
            raise InputError(f"holds an array of more than {MAX_ARRAY_BYTES} bytes", source=source)
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            found = {name: np.asarray(arrays[name], dtype=np.float64) for name in names}
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"is not a NumPy archive that can be read ({type(error).__name__})", source=source) from None
    for name, array in found.items():
        if not (np.abs(array) <= LARGEST).all():
            raise InputError(f"holds a value that is not a number within {LARGEST:g}", source=source, path=name)
    return found


def _factor(covariance: Floats) -> Floats:
    """Compute F with F F^T = the covariance; negative eigenvalues (the file's first covariance has some) count as 0."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
