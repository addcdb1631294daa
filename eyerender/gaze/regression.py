"""Interpolation-based gaze estimation: polynomials of the normalised pupil-glint vector (Blignaut 2014).

    v = (pupil - glint) / |pupil_right - pupil_left|,   x = sum_k a_k m_k(v),   y = sum_k b_k m_k(v)

with monomials m_k from Table 2 of the comparative study, fitted by least squares for each eye. Without the division the
vector is that of one eye alone (Morimoto & Mimica, CVIU 98, 2005).
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Generic, Self, TypeVar

import numpy as np
from pydantic import Field

from ..base.arrays import Floats, Ints, Objects
from ..base.errors import InputError, nearest
from ..base.spec import Spec
from ..base.storage.files import shown
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import Observations
from .builtin import BuiltIn, EstimatorOptions, this_many
from .determined import Terms, UndeterminedWarning, is_determined, monomials, shortfall
from .estimate import GazePoints
from .rays import calibrated_eyes, chosen_lights, eye_name, eyes_of, glints_of, is_none, screen_of, targets_on_screen


def _terms(text: str) -> Terms:
    """Parse terms as written in the literature, 'x + x2y + 1': exponents after the letters."""
    out = []
    for term in text.replace(" ", "").split("+"):
        i = j = 0
        rest = term
        for letter in "xy":
            if rest.startswith(letter):
                digits = "".join(c for c in rest[1:2] if c.isdigit())
                power = int(digits) if digits else 1
                rest = rest[1 + len(digits) :]
                i, j = (power, j) if letter == "x" else (i, power)
        if rest not in ("", "1") or (rest == "1" and (i or j)):
            raise InputError(f"{term!r} is not a term; write terms such as x, y2, x2y or 1")
        out.append((i, j))
    if len(set(out)) != len(out):
        raise InputError(f"{text!r} contains a term twice")
    return tuple(out)


_Y10 = "x + x2 + x3 + x4 + x5 + y + xy + x2y + x3y + x4y + x5y + 1"
_Y7 = "x + x2 + y + y2 + xy + x2y + 1"
_X8 = "x + x2 + x3 + y + xy + x2y + x3y + 1"
_X11 = "x + x2 + x3 + y + y2 + y3 + xy + x2y + x3y + 1"

# Table 2: the terms of x and of y.
FUNCTIONS: dict[str, tuple[str, str]] = {
    "R1": ("x + 1", "y + 1"),
    "R2": ("x + y + xy + 1", "x + y + xy + 1"),
    "R3": ("x + x2 + y + y2 + xy + 1", "x + x2 + y + y2 + xy + 1"),
    "R4": ("x + x2 + y + y2 + xy + x2y2 + 1", "x + x2 + y + y2 + xy + x2y2 + 1"),
    "R5": ("x + y + xy + 1", "x + y + y2 + 1"),
    "R6": ("x + x2 + y + 1", "x2 + y + xy + x2y + 1"),
    "R7": ("x + x3 + y2 + xy + 1", _Y7),
    "R8": (_X8, _Y7),
    "R9": (_X8, "x + x2 + y + xy + x2y + 1"),
    "R10": (_X8, _Y10),
    "R11": (_X11, "x + x2 + y + xy + x2y + 1"),
    "R12": (_X11, _Y10),
}
_TABLE = {name: (_terms(x), _terms(y)) for name, (x, y) in FUNCTIONS.items()}


class PolynomialFit(Spec):
    """Coefficients of one eye on the scaled vector (v - origin) / scale: a of the first polynomial, b of the second."""

    origin: tuple[float, float]
    scale: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    a: tuple[float, ...]
    b: tuple[float, ...]


Fit = TypeVar("Fit", bound=Spec)


class PolynomialEstimator(BuiltIn, Generic[Fit]):
    """An estimator with pairs of polynomials of a vector for each eye, stored as a `Fit`."""

    __slots__ = ()
    BY_EYE = "fits"
    function: str | tuple[str, str]
    fits: Mapping[int, Fit]

    def __post_init__(self) -> None:
        """Check the function where it is written; InputError if there is no such function."""
        _ = self.terms

    @property
    def terms(self) -> tuple[Terms, Terms]:
        """Exponents of the terms of both polynomials; InputError if there is no such function."""
        if isinstance(self.function, str):
            if self.function not in FUNCTIONS:
                near = nearest(self.function, FUNCTIONS) + "there are R1 to R12"
                raise InputError(f"{shown(self.function)} is not a regression function; {near}", path="function")
            x, y = FUNCTIONS[self.function]
        else:
            x, y = self.function
        return _terms(x), _terms(y)

    @property
    def function_option(self) -> dict[str, Any]:
        """The option that states the function, or its terms."""
        return {("function" if isinstance(self.function, str) else "terms"): self.function}

    @abstractmethod
    def polynomials_of(self, fit: Fit) -> Iterable[PolynomialFit]:
        """Return the pairs of polynomials of an eye."""

    def with_eyes(self, eyes: Mapping[int, Fit]) -> Self:
        """Return a copy with these coefficients.

        Raises:
            InputError: their number is not that of the terms, or the function is unknown.
        """
        for key, terms in zip("ab", self.terms, strict=True):
            for eye, fit in eyes.items():
                if any(len(getattr(one, key)) != len(terms) for one in self.polynomials_of(fit)):
                    path = f"eyes.{eye_name(eye)}.{key}"
                    raise InputError(f"must be {len(terms)} numbers, one for each term", path=path)
        return replace(self, fits=eyes)

    def evaluated(self, fit: PolynomialFit, vectors: Floats) -> Floats:
        """Evaluate a pair of polynomials at vectors (n, 2), (n, 2)."""
        x_terms, y_terms = self.terms
        u = (vectors - fit.origin) / fit.scale
        return np.stack([monomials(u, x_terms) @ fit.a, monomials(u, y_terms) @ fit.b], axis=-1)


@dataclass(frozen=True, slots=True)
class Regression(PolynomialEstimator[PolynomialFit]):
    """Polynomial regression on the vector from one light's glint to the pupil.

    >>> scene = er.load_scene("blignaut2014")
    >>> seen = er.trace(scene)
    >>> fitted = er.gaze.Regression("R3").fit(seen, scene.rig)
    >>> fitted.predict(seen, scene.rig).point_mm.shape
    (270, 3)

    Args:
        function: R1 to R12 of Table 2, or the terms of x and y, as ("x + y + 1", "x + y2 + 1").
        light: the light whose glint is used.
        normalised: divide by the distance of the two pupils; False uses the vector in pixels, of one eye alone.
        centred: expand the polynomial about the mean of the calibration vectors. This changes the result if the terms
            are not closed under a shift, as in R4 and R6 to R12.
        fits: by eye (0 right, 1 left), set by `fit`.
    """

    function: str | tuple[str, str] = "R3"
    light: int = 0
    normalised: bool = True
    centred: bool = False
    fits: Mapping[int, PolynomialFit] = field(default_factory=dict, repr=False)

    EYE = PolynomialFit

    @classmethod
    def of(cls, options: EstimatorOptions) -> Self:
        """Create the estimator, not calibrated; InputError if there is no such function."""
        (light,) = this_many((0,) if options.lights is None else options.lights, 1)
        return cls(options.terms or options.function, light, normalised=options.normalised).with_eyes({})

    def options(self) -> EstimatorOptions:
        """Return the options for a file."""
        return EstimatorOptions(**self.function_option, normalised=self.normalised, lights=(self.light,))

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Calibrate each eye.

        Raises:
            InputError: there are too few usable targets, or they do not determine the polynomial.
        """
        wanted = targets_on_screen(observations, screen_of(rig.build()))
        v, reason = pupil_glint_vectors(observations, self.light, self.normalised, rig.build())
        if self.normalised and (_partners(observations.index.frame, observations.index.eye) < 0).all():
            raise InputError(
                "no frame has both a right and a left eye, whose distance is the unit of the pupil-glint vector; "
                "for one eye give --monocular (in Python: Regression(normalised=False))"
            )
        usable = is_none(reason) & np.isfinite(wanted).all(axis=1)
        fits = {eye: self.fit_eye(v[rows], wanted[rows], name) for eye, name, rows in eyes_of(observations, usable)}
        return replace(self, fits=fits)

    def fit_eye(self, vectors: Floats, wanted: Floats, name: str) -> PolynomialFit:
        """Fit the coefficients of one eye, from vectors (n, 2) to points on the screen (n, 2) mm.

        The vectors are scaled first, which does not change the function. A subclass may solve differently. Warns with
        `UndeterminedWarning` if there are enough vectors, but in too few distinct columns or rows.

        Raises:
            InputError: as for `fit`.
        """
        x_terms, y_terms = self.terms
        need = max(len(x_terms), len(y_terms))
        origin = vectors.mean(axis=0) if self.centred and len(vectors) else np.zeros(2)
        if len(vectors) < need:
            reason = f"{len(vectors)} usable calibration targets, but {self.function} has {need} terms"
            raise InputError(f"{name} eye: {reason}{_instead(vectors - origin)}")
        scale = np.maximum(np.abs(vectors - origin).max(axis=0), 1e-300)
        u = (vectors - origin) / scale
        a = self._solve(monomials(u, x_terms), wanted[:, 0], name)
        b = self._solve(monomials(u, y_terms), wanted[:, 1], name)
        why = shortfall(vectors - origin, self.terms, str(self.function))
        if why is not None:
            warnings.warn(f"{name} eye: {why}{_instead(vectors - origin)}", UndeterminedWarning, stacklevel=3)
        return PolynomialFit.from_mapping({"origin": origin, "scale": scale, "a": a, "b": b})

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane."""
        screen = screen_of(rig.build())
        v, reason = pupil_glint_vectors(observations, self.light, self.normalised, rig.build())
        out = np.full(v.shape, np.nan)
        for rows, fit in calibrated_eyes(observations, self.fits, reason):
            out[rows] = self.evaluated(fit, v[rows])
        return GazePoints.of(screen.world(out), reason)

    def polynomials_of(self, fit: PolynomialFit) -> Iterable[PolynomialFit]:
        """Return the polynomials of an eye."""
        return (fit,)

    def _solve(self, design: Floats, wanted: Floats, eye: str) -> Floats:
        solution, _, rank, _ = np.linalg.lstsq(design, wanted, rcond=None)
        if rank < design.shape[1]:
            raise InputError(f"{eye} eye: the calibration targets do not determine {self.function} (rank {rank})")
        return np.asarray(solution)


def highest_determined(vectors: Floats) -> str | None:
    """Return the function of Table 2 with the most terms that vectors (n, 2) determine; None if there is none."""
    if not len(vectors):
        return None
    by_terms = sorted(_TABLE, key=lambda name: sum(map(len, _TABLE[name])), reverse=True)
    return next((name for name in by_terms if is_determined(vectors, _TABLE[name])), None)


def _instead(vectors: Floats) -> str:
    better = highest_determined(vectors)
    return f"; {better} is the function with the most terms that they determine" if better else ""


def pupil_glint_vectors(
    observations: Observations, light: int = 0, normalised: bool = True, rig: RigGeometry | None = None
) -> tuple[Floats, Objects]:
    """Compute pupil-glint vectors (n, 2), and the reasons (n,) where there are none; None elsewhere.

    Normalised vectors need both eyes in a frame: the distance of their pupils is the unit. Otherwise the unit is
    pixels. With a rig, `light` counts the lights that light the eye; otherwise it is the number in the records.
    """
    index, pupil = observations.index, observations.pupil
    same = np.full((len(observations), 1), light)
    glints, reason = glints_of(observations, same if rig is None else chosen_lights(observations, rig, (light,), 1))
    vectors = pupil.centre_px - glints[:, 0]
    if normalised:
        partner = _partners(index.frame, index.eye)
        reason[is_none(reason) & (partner < 0)] = (
            "the frame shows one eye; the vector is normalised by the distance of two pupils"
        )
        reason[is_none(reason) & ~pupil.ok[partner]] = "no pupil of the other eye"
        with np.errstate(invalid="ignore"):
            distance = np.linalg.norm(pupil.centre_px - pupil.centre_px[partner], axis=1)
            vectors = vectors / np.where(distance > 0, distance, np.nan)[:, None]
    return np.where(is_none(reason)[:, None], vectors, np.nan), reason


def _partners(frame: Ints, eye: Ints) -> Ints:
    """Return the row of the other eye of the same frame, -1 where there is none."""
    # The interpupillary distance of each (frame, eye), next to that of its partner. Eyes of unknown side have no
    # partner.
    key = 2 * frame + eye
    order = np.argsort(key, kind="stable")
    at = np.minimum(np.searchsorted(key[order], key ^ 1), len(key) - 1)
    found = (key[order][at] == (key ^ 1)) & (eye >= 0)
    return np.where(found, order[at], -1)
