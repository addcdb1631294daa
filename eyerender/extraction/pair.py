"""Extract both eyes of a frame, with one search in each half of the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .pipeline import extract
from .result import Extraction, PupilResult
from .settings import ExtractionSettings

OVERLAP = 0.1  # share of the width by which each half extends over the middle, because a head need not be centred
LEAST_WIDTH = 32


def extract_eyes(
    image: object,
    *,
    bit_depth: int | None = None,
    gamma: float = 1.0,
    settings: ExtractionSettings | None = None,
    prior: tuple[PupilResult | None, PupilResult | None] = (None, None),
) -> tuple[Extraction, Extraction]:
    """Extract pupils and glints of both eyes: the eye on the image's left, then the one on its right.

    The arguments are those of `extract`, with one `prior` per eye. Positions are relative to the whole image.
    """
    array = np.asarray(image)
    if array.ndim < 2 or array.shape[1] < LEAST_WIDTH:
        one = extract(array, bit_depth=bit_depth, gamma=gamma, settings=settings)
        return one, replace(one, pupil=PupilResult.missing("input", "the image is too narrow for two eyes"), glints=())
    width = array.shape[1]
    begins = (0, int((0.5 - OVERLAP) * width))
    parts = (array[:, : width - begins[1]], array[:, begins[1] :])
    left, right = (
        _moved(
            extract(part, bit_depth=bit_depth, gamma=gamma, settings=settings, prior=_shifted(before, -x0)),
            x0,
            (array.shape[0], width),
        )
        for part, x0, before in zip(parts, begins, prior, strict=True)
    )
    first, second = left.pupil.ellipse, right.pupil.ellipse
    if first is None or second is None or np.hypot(*(first.centre_px - second.centre_px)) > 2.0 * first.semi_axes_px[0]:
        return left, right
    # Both halves show the same eye. It belongs to the side on which it lies.
    other = PupilResult.missing("coarse search", "only one eye was found, on the other side of the image")
    if first.centre_px[0] < 0.5 * width:
        return left, replace(right, pupil=other, glints=(), rejected=())
    return replace(left, pupil=other, glints=(), rejected=()), right


def _moved(found: Extraction, x0: int, shape: tuple[int, int]) -> Extraction:
    """Shift the result of a part that begins at column x0 to coordinates of the whole image."""
    shift = np.array([float(x0), 0.0])
    glints, rejected = (
        tuple(replace(one, xy_px=one.xy_px + shift) for one in several) for several in (found.glints, found.rejected)
    )
    pupil = _shifted(found.pupil, x0)
    assert pupil is not None
    return replace(found, pupil=pupil, glints=glints, rejected=rejected, shape=shape)


def _shifted(pupil: PupilResult | None, dx: int) -> PupilResult | None:
    if pupil is None or pupil.ellipse is None:
        return pupil
    shift = np.array([float(dx), 0.0])
    return replace(pupil, ellipse=pupil.ellipse.shifted(shift), contour_px=pupil.contour_px + shift)
