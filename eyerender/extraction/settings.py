"""Settings of the extractor: polarity, sizes and effort."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ..spec import Positive, Spec


class ExtractionSettings(Spec):
    """Settings of `extract`; the defaults suit dark pupils in 320 x 240 to 1280 x 1024 images.

    Nothing here is tuned to a data set: thresholds adapt to the image's own noise and contrast.
    """

    method: Literal["fast", "refined"] = Field(
        default="refined", description="fast: edges and an algebraic fit; refined: also a maximum-likelihood fit"
    )
    polarity: Literal["dark", "bright"] = Field(
        default="dark", description="whether the pupil is darker or brighter than the iris"
    )
    radius_min_px: Positive = Field(default=7.0, description="smallest semi-axis b to search for")
    radius_max_px: Positive = Field(default=160.0, description="largest semi-axis a to search for")
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

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.radius_max_px <= self.radius_min_px:
            raise ValueError("radius_max_px must be > radius_min_px")
        return self


FAST = ExtractionSettings(method="fast")
REFINED = ExtractionSettings(method="refined")
