"""Settings of the extractor: polarity, sizes and effort."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ..base.spec import Positive, Spec

# A pupil of 3 px has a boundary of 19 px. A pupil is at most 8 mm x 1.2 wide; beyond 0.4 of the side, the iris around
# it (12 mm) would not be in the image.
LEAST_PX, MOST_OF_SIDE = 3.0, 0.4


class ExtractionSettings(Spec):
    """Settings of `extract`.

    No setting is tuned to a data set: thresholds adapt to the noise and contrast of the image.

    >>> er.ExtractionSettings(method="fast").method
    'fast'
    """

    method: Literal["fast", "refined", "centroid"] = Field(
        default="refined",
        description="fast: edges and an algebraic fit; refined: also a maximum-likelihood fit; centroid: area and "
        "centre of mass of the thresholded pupil",
    )
    reflections: Literal["filled", "excluded"] = Field(
        default="filled", description="centroid: whether reflections that the pupil encloses belong to it"
    )
    polarity: Literal["auto", "dark", "bright"] = Field(
        default="auto", description="whether the pupil is darker or brighter than the iris; auto: the image decides"
    )
    radius_min_px: Positive | None = Field(default=None, description="smallest semi-axis b to search for; null: 3 px")
    radius_max_px: Positive | None = Field(
        default=None, description="largest semi-axis a to search for; null: 0.4 of the image's shorter side"
    )
    aspect_min: Annotated[float, Field(gt=0, le=1)] = Field(default=0.3, description="smallest accepted b / a")
    min_support: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.2, description="smallest visible share of the pupil boundary"
    )
    min_confidence: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.5, description="pupils with a lower probability of being right (IoU > 0.9) are reported as missing"
    )
    max_glints: Annotated[int, Field(ge=0, le=64)] = Field(default=16, description="largest number of reported glints")
    glint_reach: Positive = Field(
        default=4.0, description="search radius for glints around the pupil centre, in semi-axes a"
    )

    arrangement: Literal["face", "side-by-side", "stacked"] = Field(
        default="face",
        description="images of both eyes: a view of the face, or pictures of two cameras, beside or above each other",
    )
    order: Literal["right-left", "left-right"] = Field(
        default="right-left", description="the subject's eyes in such an image: from the left, or from above"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.radius_min_px, self.radius_max_px
        if low is not None and high is not None and high <= low:
            raise ValueError("radius_max_px must be > radius_min_px")
        return self


@dataclass(frozen=True, slots=True)
class Shape:
    """Accepted sizes and shapes of a pupil: semi-axes from b >= `least_px` to a <= `most_px`, b / a, visible share."""

    least_px: float
    most_px: float
    aspect: float
    support: float

    @staticmethod
    def of(settings: ExtractionSettings, shape: tuple[int, int]) -> Shape:
        """Compute the limits from the settings and the (h, w) of the image."""
        low, high = settings.radius_min_px, settings.radius_max_px
        least = LEAST_PX if low is None else low
        most = max(MOST_OF_SIDE * min(shape), 2.0 * least) if high is None else high
        return Shape(least, most, settings.aspect_min, settings.min_support)


FAST = ExtractionSettings(method="fast")
REFINED = ExtractionSettings(method="refined")
