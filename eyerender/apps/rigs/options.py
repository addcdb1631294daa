"""Options of the report on a rig, shared by Python and the command line."""

from __future__ import annotations

from dataclasses import dataclass

from ...backends.choose import BackendChoice
from ...base.errors import InputError

LIMITS = {
    "people": (1, 10**6), "sample": (0, 1000), "images": (0, 1000), "workers": (1, 1024), "seed": (0, 2**63 - 1),
    "slippage_mm": (0, 20), "relief_mm": (0, 20), "azimuth_deg": (1, 60), "elevation_deg": (1, 60),
    "luminance": (1e-3, 1e5),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class RigSize:
    """Size of the computation.

    Attributes:
        people: Number of people.
        sample: Number of people for the errors of estimators on exact features.
        images: Number of people for errors on rendered images, 25 each (a few seconds per image).
        workers: Number of processes (default: one per processor). Results do not depend on it.
        seed: The seed of the people.
        slippage_mm: Standard deviation of the eyes' positions about the scene's, along each axis.
        relief_mm: Additional standard deviation along x, for the eye relief of a headset (3 is a good choice).
        azimuth_deg: Half range of the directions of gaze, horizontally.
        elevation_deg: Half range of the directions of gaze, vertically.
        luminance: Luminance (cd/m2) of what people see, which sets their pupils.
        backend: The render backend of the images.
    """

    people: int = 200
    sample: int = 5
    images: int = 0
    workers: int | None = None
    seed: int = 0
    slippage_mm: float = 1.5
    relief_mm: float = 0.0
    azimuth_deg: float = 20.0
    elevation_deg: float = 15.0
    luminance: float = 20.0
    backend: BackendChoice = "auto"

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"must be {low} to {high}, not {value:g}", path=name)
