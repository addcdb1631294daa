"""Maximum-likelihood gaze: fit a traced eye model to pupil outlines and glints.

A calibration fits the person (the cornea's surfaces, place and outline of the pupil, kappa, centres of rotation) with
the priors of people, together with gaze, pupil and slippage of every frame. Afterwards these three are fitted for each
frame alone. It is `design.fit` with equation (4) there, and approaches the Cramer-Rao bound of the rig where the model
holds. What makes a fit doubtful (`EyeFit.doubts`) is a `FitWarning`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field

from ..base.arrays import Floats, frozen
from ..base.errors import FitWarning, InputError
from ..base.spec import Spec
from ..rig.rig import RigLike
from ..scene.observation import EYES, Observations
from .builtin import BuiltIn
from .estimate import GazePoints, GazeRays
from .rays import NOT_CALIBRATED, is_none, screen_of

if TYPE_CHECKING:
    from ..design.fit import EyeFit

PERSON_NUMBERS = 29
OUTLINE_PX, GLINT_PX = 0.2, 0.1
"""Deviations of features without a covariance (chosen): a sensor's noise, and what eyes still differ from the model."""
FAR, UNSETTLED = "no eye near its place explains the features", "the fit did not converge"


class _EyePerson(Spec):
    person: Annotated[tuple[float, ...], Field(min_length=PERSON_NUMBERS, max_length=PERSON_NUMBERS)]


@dataclass(frozen=True, slots=True)
class MaximumLikelihood(BuiltIn):
    """Estimate gaze by fitting an eye model to the features of every frame.

    >>> scene = er.load_scene("guestrin2006")
    >>> seen = er.trace(scene.frames()[:6])
    >>> fitted = er.gaze.MaximumLikelihood().fit(seen, scene.rig)
    >>> fitted.predict(seen, scene.rig).point_mm.shape
    (6, 3)

    Args:
        eye: name of the eye model from which the fits start.
        slippage_mm: standard deviation of the eye's position in a frame about the one in the record; 0: it is exact.
        persons: numbers of the person (29,) by eye (0 right, 1 left), set by `fit`.
    """

    eye: str = "adult"
    slippage_mm: float = 3.0
    persons: Mapping[int, Floats] = field(default_factory=dict, repr=False)

    OPTIONS = ("eye", "slippage_mm")
    BY_EYE, EYE, ARRAY = "persons", _EyePerson, "person"

    def fit(self, observations: Observations, rig: RigLike) -> Self:
        """Fit each eye's person to calibration targets.

        Warns:
            FitWarning: the features differ from those of any eye of the model, or do not determine the person.

        Raises:
            InputError: there are no targets or no features, or they lead to an eye that cannot exist.
        """
        from ..design.unknowns import LOCAL, Unknowns

        if not np.isfinite(observations.index.target_mm).all(axis=1).any():
            raise InputError("a calibration needs records with target_mm")
        unknowns = Unknowns.population(slippage_mm=self._slippage)
        fits = self._fits(observations, rig, unknowns, targets=True)
        return replace(self, persons={eye: frozen(found.theta[0, LOCAL:]) for eye, found in fits.items()})

    def predict(self, observations: Observations, rig: RigLike) -> GazePoints:
        """Estimate gaze points on the screen's plane."""
        rig = rig.build()
        screen = screen_of(rig, "predict_rays gives rays without one")
        return self.predict_rays(observations, rig).on_screen(screen, "the line of sight")

    def predict_rays(self, observations: Observations, rig: RigLike) -> GazeRays:
        """Estimate lines of sight; no screen is needed."""
        from ..design.unknowns import Unknowns

        if not self.persons:
            raise InputError("the estimator is not calibrated; call fit first")
        n = len(observations)
        reason = np.full(n, None, dtype=object)
        reason[~np.isin(observations.index.eye, list(self.persons))] = NOT_CALIBRATED
        reason[is_none(reason) & ~observations.pupil.ok] = "no pupil"
        usable = np.flatnonzero(is_none(reason))
        origin, direction = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        if len(usable):
            unknowns = Unknowns(slippage_mm=self._slippage)
            for found in self._fits(observations.take(usable), rig, unknowns, targets=False).values():
                rows = usable[found.rows]
                origin[rows], direction[rows] = found.origin_mm[found.instant], found.direction[found.instant]
                reason[rows[~found.converged[found.instant]]] = UNSETTLED
                reason[rows[np.isnan(direction[rows, 0])]] = FAR
        return GazeRays.of(origin, direction, reason)

    @property
    def _slippage(self) -> Literal["known"] | float:
        return self.slippage_mm if self.slippage_mm > 0 else "known"

    def _fits(self, observations: Observations, rig: RigLike, unknowns: object, *, targets: bool) -> dict[int, EyeFit]:
        """Fit each eye's frames; the person's numbers are fixed if they are known and no targets are used."""
        from ..design.fit import Options, fit_one, warn_of
        from ..design.noise import FeatureNoise
        from ..design.unknowns import Unknowns
        from ..eye.catalogue import load_eye

        assert isinstance(unknowns, Unknowns)
        built = rig.build()
        if observations.lens_glints is not None and observations.lens_glints.ok.any():
            warnings.warn("the eyes are behind spectacles, which the model does not have", FitWarning, stacklevel=4)
        noise = FeatureNoise.of(OUTLINE_PX, GLINT_PX, rig=built)
        out = {}
        for eye in np.unique(observations.index.eye):
            options = Options(targets=targets, person=None if targets else self.persons[int(eye)])
            rows = np.flatnonzero(observations.index.eye == eye)
            try:
                out[int(eye)] = fit_one(observations, rows, built, load_eye(self.eye), unknowns, noise, options)
            except InputError as error:
                raise error.placed(under=f"{EYES[max(int(eye), 0)]} eye") from None
            warn_of(out[int(eye)], stacklevel=5)
        return out
