"""An image of one eye with its labels, as every reader of a folder gives it to the benchmark."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bytes, Floats
from ...folders.imagefile import read_any_image, read_image
from ...optics.ellipse import Ellipse
from .bound import Edge
from .glintlabels import TrueGlint


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchImage:
    """One image of one eye; positions are relative to the image, with pixel centres at integers."""

    name: str  # name of the image
    path: Path  # file
    bit_depth: int  # bits of the file
    size: tuple[int, int]  # (width, height)
    pupil: Ellipse | None = None  # None where the image shows none, or only its centre is known
    outline_px: Floats = field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2) outline of the pupil
    visible: float | None = None  # visible share of the pupil; None if unknown
    glints: tuple[TrueGlint, ...] = ()  # glints that the image shows
    hints: Mapping[str, Any] = field(default_factory=dict)  # information given to extractors
    # noise (DN), blur (px) and step (DN), if the folder states them
    known: Mapping[str, float] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)  # possible causes of an error, by name
    # where the gamma of the hints comes from: the folder, an option (`given`), or nowhere (`assumed`)
    gamma_from: str = "folder"
    subject: str = ""  # the person; if "" (unknown), each image counts as a separate subject
    iris: Ellipse | None = None  # outline of the iris; None if unknown
    lids_px: tuple[Floats, ...] = ()  # (n, 2) margins of the lids, as far as they are known
    mask_path: Path | None = None  # file of the classes of the pixels; None if unknown
    conditions: tuple[str, ...] = ()  # hard conditions (`conditions.CONDITIONS`)
    hidden_glints_px: tuple[tuple[float, float], ...] = ()  # positions of glints that are hidden in the image
    centre_px: tuple[float, float] | None = None  # (x, y) of a pupil of which only the centre is known
    edge: Edge | None = None  # the pupil's edge (`bound`); None if it is unknown
    sigma_px: float | None = None  # bound of the centre's standard deviation per axis; None where it does not apply
    recording: str = ""  # what the frames of one eye, seen by one camera, share
    time_s: float | None = None  # time of the frame in its recording; None outside sequences

    @classmethod
    def read(
        cls, name: str, path: Path, pupil: Ellipse | None = None, *, visible: float | None = None, **labels: Any
    ) -> BenchImage:
        """Read size and bit depth of an image of which the labels alone are known, no camera and no lights.

        A pupil of which nothing is visible (share 0) is not shown; `labels` are further attributes.
        """
        image, depth, _ = read_any_image(path)
        height, width = image.shape
        pupil = None if visible == 0.0 else pupil
        return cls(
            name=name,
            path=path,
            size=(width, height),
            pupil=pupil,
            outline_px=np.zeros((0, 2)) if pupil is None else pupil.points(120),
            visible=visible,
            factors=factors_of(pupil, visible),
            **{"bit_depth": depth, **labels},
        )

    @property
    def shows_pupil(self) -> bool:
        """Whether the image shows a pupil, of which the ellipse or only the centre is known."""
        return self.pupil is not None or self.centre_px is not None

    @property
    def glints_px(self) -> Floats:
        """Positions (n, 2) of the glints that the image shows."""
        return np.array([g.xy_px for g in self.glints], dtype=np.float64).reshape(-1, 2)

    def contains(self, x: float, y: float) -> bool:
        """Return whether a position lies on the image."""
        width, height = self.size
        return -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5

    def grey(self) -> NDArray[Any]:
        """Read the grey levels (h, w) as stored."""
        return read_any_image(self.path)[0]

    def pixels(self) -> tuple[NDArray[Any], Bytes | None]:
        """Read the grey levels and the classes."""
        return read_any_image(self.path)[0], None if self.mask_path is None else read_image(self.mask_path)[0]

    def classes(self) -> Bytes | None:
        """Read the class of each pixel (0 skin, 1 sclera, 2 iris, 3 pupil, 4 or 5 a frame); None if unknown."""
        return None if self.mask_path is None else np.asarray(read_image(self.mask_path)[0], dtype=np.uint8)


def factors_of(pupil: Ellipse | None, visible: float | None) -> dict[str, float]:
    """Return possible causes of an error that follow from a pupil's outline and its visible share."""
    if pupil is None:
        return {}
    a, b = pupil.semi_axes_px
    x, y = pupil.centre_px % 1.0
    out = {"pupil_px": math.sqrt(a * b), "aspect": b / a, "phase_x": float(x), "phase_y": float(y)}
    return out if visible is None else out | {"occlusion": 1.0 - visible}
