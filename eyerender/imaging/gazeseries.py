"""Gaze of each eye in a trace as a tracker reports it: where the line of sight meets the screen, and the pupil.

Gaze is the true line of sight with the tracker's noise in degrees. Positions on a screen are in pixels from its upper
left corner. Without a screen they are the azimuth and the elevation of the line of sight in the world, in degrees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ..base.arrays import Floats, Objects
from ..base.errors import InputError, InputWarning
from ..eye.pose import Poses, rigid_motion
from ..rig.screen import ScreenPlane
from ..scene.observation import EYES, correlated
from .trace import Trace

SCREEN_PX = (1920, 1080)


def check_screen(screen_px: tuple[int, int]) -> None:
    """Check the width and height of a screen's picture. Raises InputError if a side is not 1 to 65,536 pixels."""
    if min(screen_px) < 1 or max(screen_px) > 65536:
        raise InputError("must be 1 to 65536", source="--screen-px")


def screen_warnings(screen: ScreenPlane, screen_px: tuple[int, int]) -> list[InputWarning]:
    """Warn of pixels that are more than 2 % from square."""
    across, down = (mm / px for mm, px in zip(screen.size_mm, screen_px, strict=True))
    if abs(across / down - 1) < 0.02:
        return []
    sizes = f"{screen.size_mm[0]:g} x {screen.size_mm[1]:g} mm"
    reason = f"{screen_px[0]} x {screen_px[1]} on {sizes} gives pixels of {across:.3g} x {down:.3g} mm, not square"
    return [InputWarning(code="pixels", reason=reason, source="--screen-px")]


class Display(NamedTuple):
    """A screen in the world, and the width and height of its picture in pixels."""

    plane: ScreenPlane
    size_px: tuple[int, int]

    @property
    def px_per_mm(self) -> Floats:
        """Pixels per mm, (2,) to the right and down."""
        return np.asarray(np.array(self.size_px) / np.array(self.plane.size_mm))

    def pixels(self, origin_mm: Floats, direction: Floats) -> Floats:
        """Return where rays (n, 3) meet the screen: (n, 2) px; NaN where it is not ahead."""
        place, _ = self.plane.intersect(origin_mm, direction)
        return place * (1, -1) * self.px_per_mm + (np.array(self.size_px) - 1) / 2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GazeSeries:
    """Samples of one eye."""

    eye: str  # `right` or `left`
    rate_hz: float  # samples per second
    time_s: Floats  # (n,) times
    place: Floats  # (n, 2) gaze: px on the display, else azimuth and elevation in degrees; NaN where it is missing
    direction: Floats  # (n, 3) true line of sight in the world
    origin_mm: Floats  # (n, 3) points on it
    pupil_mm: Floats  # (n,) diameter of the stop; NaN where the pupil is missing
    lid_opening_mm: Floats  # (n,) opening of the lids; NaN if unknown
    events: Objects  # (n,) what happens, joined by `+`
    display: Display | None  # where gaze is stated; None: in degrees


class Stretch(NamedTuple):
    """Samples `first` to `last` of one kind."""

    kind: str
    first: int
    last: int


def runs(kind: Objects) -> list[Stretch]:
    """Divide a series (n,) of names into runs of one name."""
    edges = np.flatnonzero(np.concatenate([[True], kind[1:] != kind[:-1], [True]])).tolist()
    return [Stretch(str(kind[a]), a, b - 1) for a, b in pairwise(edges)]


def places_of(origin_mm: Floats, direction: Floats, display: Display | None) -> Floats:
    """Return gaze (n, 2) of lines of sight: px on a display, or azimuth and elevation in degrees."""
    if display is not None:
        return display.pixels(origin_mm, direction)
    x, y, z = direction.T
    return np.asarray(np.degrees(np.stack([np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))], axis=1)))


def gaze_series(trace: Trace, screen_px: tuple[int, int] = SCREEN_PX) -> Iterator[tuple[GazeSeries, Floats]]:
    """Yield the series of each eye of a trace, the left one first, and the areas (n,) px^2 of its pupil in the picture.

    Raises:
        InputError: several cameras see an eye.
    """
    index, scene = trace.observations.index, trace.scene
    screen = scene.rig.screen
    display = None if screen is None else Display(screen, screen_px)
    for number in sorted(set(index.eye.tolist()), reverse=True):
        rows = np.flatnonzero(index.eye == number)
        if len(set(index.camera[rows].tolist())) > 1:
            raise InputError("must be one for each eye for this format", source=scene.source, path="rig.cameras")
        yield _one(trace, number, rows, display)


def _one(trace: Trace, number: int, rows: Any, display: Display | None) -> tuple[GazeSeries, Floats]:
    """Compute the series of one eye."""
    seen, tracker = trace.observations, trace.tracker
    eye = trace.scene.eye(EYES[number])
    index, pose, pupil = seen.index.take(rows), seen.pose.take(rows), seen.pupil.take(rows)
    turn, shift = rigid_motion(Poses(pose.azimuth_rad, pose.elevation_rad, pose.torsion_rad), eye)
    direction = turn @ eye.chief_ray.direction
    origin = turn @ eye.chief_ray.point_mm + shift + index.eye_position_mm + index.head_mm
    rng = np.random.default_rng((tracker.seed, number, 0xA5C))
    noise = np.radians(tracker.noise_deg) * correlated(rng.standard_normal((len(rows), 2)), tracker.noise_type)
    across = [[0, -1, 0], [0, 0, 1]] if display is None else [display.plane.right, display.plane.up]
    noisy = direction + noise @ np.array(across, dtype=float)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    found = np.asarray(pupil.ok)
    series = GazeSeries(
        eye=EYES[number],
        rate_hz=tracker.rate,
        time_s=index.time_s,
        place=np.where(found[:, None], places_of(origin, noisy, display), np.nan),
        direction=direction,
        origin_mm=origin,
        pupil_mm=np.where(found, trace.stop_mm()[rows], np.nan),
        lid_opening_mm=trace.lid_opening_mm[rows],
        events=index.events,
        display=display,
    )
    return series, np.where(found, np.pi * np.prod(pupil.semi_axes_px, axis=1), np.nan)
