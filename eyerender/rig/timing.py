"""When cameras expose: frame rates, clocks, shutters of rows, and pulses of LEDs.

Row r of frame k is exposed from t_k + r t_row on, with t_k = phase + k / (rate (1 + ppm 1e-6)); t_row is 0 with a
global shutter. A row receives the light of a pulse only while it is exposed: its light is the overlap, its time the
middle of the overlap. LEDs without a pulse, and all other light, are always on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Discriminator, Field, Tag

from ..base.arrays import ArrayValue, Bools, Floats, Ints
from ..base.spec import NonNegative, Positive, Spec

DEFAULT_RATE_HZ = 60.0
"""Frame rate of a camera that states none (chosen)."""

ALWAYS_S = (-np.inf, np.inf)
"""The pulse of an LED that is always on."""


class RollingShutter(Spec):
    """Rows are exposed one after the other, from the top of the stored picture down."""

    row_us: Positive = Field(description="time from the start of one row's exposure to that of the next")


class Rolling(Spec):
    """A rolling shutter."""

    rolling: RollingShutter = Field(description="its rows")


class InterlacedShutter(Spec):
    """Odd rows are exposed later than even ones, as two fields."""

    delay_ms: NonNegative = Field(description="delay of the second field (NTSC 16.7 ms, PAL 20 ms)")


class Interlaced(Spec):
    """An interlaced camera."""

    interlaced: InterlacedShutter = Field(description="its fields")


def _shutter_tag(value: Any) -> str:
    if isinstance(value, str):
        return "TextSpec"
    named = isinstance(value, Interlaced) or (isinstance(value, Mapping) and "interlaced" in value)
    return "[interlaced]" if named else "[rolling]"


Shutter = Annotated[
    Annotated[Literal["global"], Tag("TextSpec")]
    | Annotated[Rolling, Tag("[rolling]")]
    | Annotated[Interlaced, Tag("[interlaced]")],
    Discriminator(_shutter_tag),
]


class Pulse(Spec):
    """When an LED is on, in each frame of each camera that takes pictures."""

    start_ms: NonNegative = Field(default=0.0, description="start after that of the first row's exposure")
    width_ms: Positive = Field(description="how long it is on")

    @property
    def span_s(self) -> tuple[float, float]:
        """Start and end after the start of a frame, s."""
        return self.start_ms * 1e-3, (self.start_ms + self.width_ms) * 1e-3


class Light(NamedTuple):
    """Overlap of rows with a pulse, arrays of one shape: its middle (s; NaN without one), and its share."""

    time_s: Floats
    share: Floats


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FrameTimes(ArrayValue):
    """Times of one camera's frames."""

    rate_hz: float  # frames per second by the camera's own clock
    period_s: float  # time from one frame to the next, by the true clock
    phase_s: float  # start of the first frame
    exposure_s: float  # exposure time of a row
    row_s: float  # time from row to row; 0 with a global shutter
    rows: int  # number of rows
    # (m, 2) start and end of the pulse of each light, after the start of a frame; -inf and inf without one
    pulses_s: Floats
    # how much later odd rows are exposed than even ones; features are those midway between both
    field_delay_s: float = 0.0

    @property
    def is_rolling(self) -> bool:
        """Whether rows are exposed at different times."""
        return self.row_s > 0.0

    def start_s(self, frame: ArrayLike) -> Floats:
        """Return when the exposure of the first row of frames begins."""
        return np.asarray(self.phase_s + np.asarray(frame, dtype=float) * self.period_s)

    def frames_within(self, duration_s: float) -> int:
        """Return how many frames a sequence has: as many as fit into it by the camera's own clock, and at least one."""
        return max(1, int(duration_s * self.rate_hz + 1e-6))

    def ambient_s(self, start_s: ArrayLike, row: ArrayLike) -> Floats:
        """Return the middle of the exposure of rows, which may be fractions; a row below 0 is the first one."""
        inside = np.clip(np.asarray(row, dtype=float), 0.0, self.rows - 1.0)
        return np.asarray(np.asarray(start_s) + inside * self.row_s + (self.field_delay_s + self.exposure_s) / 2.0)

    def lit(self, start_s: ArrayLike, row: ArrayLike, light: int) -> Light:
        """Return what rows (n, k) of frames that start at (n,) get of a light; rows may be fractions."""
        begin = np.clip(np.asarray(row, dtype=float), 0.0, self.rows - 1.0) * self.row_s + self.field_delay_s / 2.0
        low = np.maximum(begin, self.pulses_s[light, 0])
        high = np.minimum(begin + self.exposure_s, self.pulses_s[light, 1])
        share = np.maximum(high - low, 0.0) / self.exposure_s
        return Light(np.where(share > 0.0, np.reshape(start_s, (-1, 1)) + (low + high) / 2.0, np.nan), share)

    def seen(self, start_s: ArrayLike, row: ArrayLike, lights: Ints) -> Light:
        """Return what rows (n, k) get of several lights together: the mean time of their light, and all shares.

        Without any light, it is the middle of the exposure.
        """
        if not len(lights):
            when = self.ambient_s(np.reshape(start_s, (-1, 1)), row)
            return Light(when, np.ones(when.shape))
        each = [self.lit(start_s, row, int(light)) for light in lights]
        total = np.asarray(sum(one.share for one in each))
        weighted = sum(np.where(one.share > 0.0, one.share * one.time_s, 0.0) for one in each)
        return Light(np.where(total > 0.0, weighted / np.where(total > 0.0, total, 1.0), np.nan), total)

    def segments(self, first_row: int, last_row: int, lights: Ints) -> tuple[Floats, Bools]:
        """Divide the exposure of some rows at the edges of pulses and fields.

        Returns:
            Edges (k + 1,) in s after the frame's start, and which lights (k, m) are on between them.
        """
        begin, end = first_row * self.row_s, last_row * self.row_s + self.field_delay_s + self.exposure_s
        pulses = self.pulses_s[lights]
        inside = pulses[(pulses > begin) & (pulses < end)]
        fields = np.array([self.exposure_s, self.field_delay_s] if self.field_delay_s else [])
        edges = np.unique(np.concatenate([[begin], inside, fields[(fields > begin) & (fields < end)], [end]]))
        middle = (edges[:-1] + edges[1:]) / 2.0
        return edges, (middle[:, None] > pulses[None, :, 0]) & (middle[:, None] < pulses[None, :, 1])

    def shares(self, edges_s: Floats, rows: Ints) -> Floats:
        """Return the share of each row's exposure (k, rows) between edges (k + 1,), in s after the frame's start."""
        begin = rows * self.row_s + (rows % 2) * self.field_delay_s
        inside = np.clip(edges_s[:, None], begin, begin + self.exposure_s)
        return np.asarray(np.diff(inside, axis=0) / self.exposure_s)
