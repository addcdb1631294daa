"""Six known layouts of eye trackers, two remote ones and four in headsets, as scenes of one right eye.

Sources: the remote ones are shipped scenes (the replicated studies). The headsets follow public pictures and data sets:
a frame with a camera below the eye and two LEDs at it (Pupil Labs Core; Kassner et al. 2014), four LEDs behind a
display lens with a camera below (NVGaze; Kim et al. 2019), six LEDs around a lens with a camera at its temporal rim
(OpenEDS; Garbin et al. 2019), and a camera at the temple that sees the eye in a hot mirror between eye and lens.
Positions in millimetres were chosen to reproduce such pictures; the makers publish none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...scene import load_scene

_AIM = [-4.0, -31.5, 0.0]
_SENSOR = {"f_number": 2.2, "exposure_ms": 2.0, "pixel_pitch_um": 3.0, "full_well_e": 8000, "read_noise_e": 4}


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownLayout:
    """A layout of the study."""

    name: str  # name of the layout
    text: str  # short description
    headset: bool  # whether the rig moves with the head
    scene: dict[str, Any]  # mapping of its scene

    @property
    def slippage_mm(self) -> float:
        """Standard deviation of the eye's position per axis: slippage of a headset, or head motion (chosen)."""
        return 1.5 if self.headset else 15.0

    @property
    def relief_mm(self) -> float:
        """Standard deviation of a headset's eye relief, 18 +- 3 mm (chosen)."""
        return 3.0 if self.headset else 0.0


def known_layouts() -> tuple[KnownLayout, ...]:
    """Return the six layouts."""
    return (
        _remote("guestrin2006", "remote, one camera, two LEDs beside the screen"),
        _remote("blignaut2014", "remote, one camera, one LED above it"),
        _headset("frame_2_leds", "glasses frame, camera below the eye, two LEDs at it", [26, -47, -25],
                 [[27, -51, -23], [27, -43, -27]], (500, [400, 400]), 3.9),
        _headset("lens_4_leds", "headset, camera below the lens, four LEDs about it", [34, -34, -32],
                 [[34, y, z] for z in (14, -18) for y in (-54, -12)], (760, [640, 480]), 2.9),
        _headset("lens_6_leds", "headset, camera at the lens' rim, six LEDs around the lens", [43, -36, -16],
                 _ring(36.0, 20.0, 6), (640, [400, 640]), 3.55),
        _headset("hot_mirror_8_leds", "headset, camera at the temple seen in a hot mirror, eight LEDs around the lens",
                 [20, -62, 0], _ring(30.0, 20.0, 8), (640, [480, 400]), 2.0,
                 {"look_at_mm": [20.7, -32.5, -2.5],
                  "mirror": {"point_mm": [35.0, -48.0, -3.0], "normal": [30.0, 28.0, -6.0]}}),
    )  # fmt: skip


def _ring(away_mm: float, radius_mm: float, count: int) -> list[list[float]]:
    """Return positions on a circle around the eye's axis, the first one above it."""
    angles = 2.0 * np.pi * np.arange(count) / count
    return [[away_mm, -31.5 + radius_mm * float(np.sin(a)), radius_mm * float(np.cos(a))] for a in angles]


def _remote(name: str, text: str) -> KnownLayout:
    """Create a layout from a shipped scene's first eye and first head position."""
    data = load_scene(name).spec.to_mapping()
    subject = {**data["subject"], "eyes": ["right"], "head_positions_mm": [[0.0, 0.0, 0.0]]}
    return KnownLayout(name=name, text=text, headset=False, scene={**data, "subject": subject})


def _headset(
    name: str,
    text: str,
    camera_mm: list[float],
    leds_mm: list[list[float]],
    picture: tuple[float, list[int]],
    intensity_mw_sr: float,
    more: dict[str, Any] | None = None,
) -> KnownLayout:
    """Create a layout of one camera and LEDs before the right eye; `picture` is focal length and size in pixels."""
    focal, size = picture
    camera = {
        "position_mm": camera_mm, "look_at_mm": _AIM, "focal_length_px": focal, "resolution_px": size, **(more or {})
    }  # fmt: skip
    led = {"radius_mm": 0.6, "aim_mm": _AIM, "intensity_mw_sr": intensity_mw_sr}
    scene = {
        "format": 2,
        "name": name,
        "subject": {"eyes": ["right"], "ipd_mm": 63.0},
        "rig": {"cameras": [camera], "lights": [{**led, "position_mm": place} for place in leds_mm]},
        "poses": [{"azimuth_deg": 0.0, "elevation_deg": 0.0}],
        "sensor": _SENSOR,
    }
    return KnownLayout(name=name, text=text, headset=True, scene=scene)
