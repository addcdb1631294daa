"""The eye file: a right eye as the user writes it, validated and built."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from ..base.errors import InputError
from ..base.spec import KeyProblem, Side
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
        return build_eye(self, eye, wavelength_nm, pupil_diameter_mm)
