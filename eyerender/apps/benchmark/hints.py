"""Hints for extractors about the user's own images: hints.json in the folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from ...base.errors import InputError
from ...base.spec import NonNegative, Positive, Spec, Vec3
from ...base.storage.files import read_json, shown
from ...rig.distortion import Distortion

HINTS = "hints.json"
HINTS_SCHEMA = "eyerender/hints/1"
NO_HINTS: dict[str, Any] = {"polarity": "auto", "gamma": 1.0, "radius_px": None, "rig": None, "prior": None}
"""Hints of a request about an image of which nothing is known."""


class RigHints(Spec):
    """Camera and lights, in the form given to extractors."""

    K: tuple[Vec3, Vec3, Vec3]  # camera matrix, px
    R: tuple[Vec3, Vec3, Vec3]  # rotation from the world to the camera
    t_mm: Vec3  # translation from the world to the camera
    distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)  # as of a camera of a scene
    lights_mm: Annotated[tuple[Vec3, ...], Field(max_length=1000)]  # positions of the lights in the world
    eye_mm: Vec3  # approximate position of the eye in the world
    eye_sd_mm: NonNegative = 5.0  # its standard deviation per axis


class FolderHints(Spec):
    """Hints for every image of a folder; a missing key is unknown."""

    gamma: Annotated[float, Field(ge=0.1, le=10)] | None = None  # encoding gamma of the pixel values, 1 for linear ones
    polarity: Literal["dark", "bright", "auto"] = "auto"  # whether the pupil is darker or brighter than the iris
    radius_px: tuple[Positive, Positive] | None = None  # smallest and largest semi-axis of a pupil
    rig: RigHints | None = None  # camera and lights

    @classmethod
    def load(cls, folder: Path) -> FolderHints:
        """Read hints.json of a folder; without the file, nothing is known. Raises InputError, naming the wrong key."""
        path = folder / HINTS
        if not path.exists():
            return cls()
        data = read_json(path, follow=False)
        schema = data.pop("schema", None)
        if schema != HINTS_SCHEMA:
            raise InputError(f"must be {HINTS_SCHEMA!r}, not {shown(schema)}", source=str(path), path="schema")
        return cls.from_mapping(data, source=str(path))

    def to_request(self) -> dict[str, Any]:
        """Return the hints of a request; an unknown gamma becomes 1."""
        rig = None if self.rig is None else self.rig.model_dump(mode="json")
        radius = None if self.radius_px is None else list(self.radius_px)
        return {"polarity": self.polarity, "gamma": self.gamma or 1.0, "radius_px": radius, "rig": rig, "prior": None}
