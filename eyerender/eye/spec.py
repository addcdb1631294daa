"""The eye file: a right eye as the user writes it, validated and built."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from ..base.errors import InputError
from ..base.spec import KeyProblem, Side
from .biometry import MEASURED, with_biometry
from .build import build_eye
from .check import check_eye
from .model import EyeModel
from .parts import EyeParts
from .topography import with_topographies


class EyeSpec(EyeParts):
    """A right eye whose geometry is possible.

    >>> er.load_eye("E4").build().name
    'E4'
    """

    @classmethod
    def gathered(cls, data: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Read the files of measured points that the shapes name, and replace them by fitted grids."""
        return with_topographies(data, folder)

    @classmethod
    def arranged(cls, data: Mapping[str, Any]) -> Mapping[str, Any]:
        """Replace the numbers of a biometer by the keys that follow from them."""
        return with_biometry(data) if "biometry" in data else data

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema, in which a file has either all required keys or `biometry`."""
        schema = super().json_schema()
        from_biometer = {"required": ["biometry"], "not": {"anyOf": [{"required": [key]} for key in MEASURED]}}
        whole = {"required": schema.pop("required"), "not": {"required": ["biometry"]}}
        return {**schema, "oneOf": [whole, from_biometer]}

    @model_validator(mode="after")
    def _check(self) -> Self:
        try:
            check_eye(self)
        except InputError as error:
            raise KeyProblem(error.path, error.reason) from None
        return self

    def build(
        self, *, eye: Side = "right", wavelength_nm: float = 850.0, pupil_diameter_mm: float | None = None
    ) -> EyeModel:
        """Build the numeric model at a wavelength (nm) with a pupil (mm; the file's own if None)."""
        return build_eye(self.of_side(eye), eye, wavelength_nm, pupil_diameter_mm)

    def of_side(self, side: Side) -> Self:
        """Return the eye whose mirror image is the left one, also where `toric_axis` says that this one is not."""
        if side == "right" or self.toric_axis is None:
            return self
        x, y, z = self.cornea[0].tilt_deg
        turned = self.cornea[0].model_copy(update={"tilt_deg": (-x, y, z)})
        return self.model_copy(update={"cornea": (turned, *self.cornea[1:]), "toric_axis": None})
