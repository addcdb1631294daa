"""The automatic exposure of a scene's images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..rig.exposure import electrons
from ..scene import Scene
from ..scene.parts import FRAME
from .capture import make_renderer, render_windows

if TYPE_CHECKING:
    from ..rendering.renderer import Renderer

_LOOKED_AT = 6  # number of frames on which the exposure is measured
_LONGEST_MS = 1000.0


def auto_exposed(
    scene: Scene,
    level: float = 0.7,
    *,
    share: float = 0.98,
    backend: BackendChoice = "auto",
    threads: int | None = None,
) -> Scene:
    """Set one exposure for all images of a scene, as the automatic exposure of a camera would.

    The exposure time is chosen so that the share `share` of pixels is at most `level` of full scale (linear, black
    level included). It is measured on a few evenly chosen frames, rendered with few samples. Frames around the view do
    not count.

    >>> er.auto_exposed(er.load_scene("headset"), level=0.7).spec.sensor.exposure_s  # doctest: +SKIP

    Args:
        scene: the scene.
        level: share of full scale.
        share: share of the pixels at or below this level.
        backend: the render backend.
        threads: total number of processor threads; None: all.

    Returns:
        The scene with another `sensor.exposure_ms`.

    Raises:
        InputError: an argument is out of range, or the images are dark.
    """
    if not 0.01 <= level <= 2:
        raise InputError("must be 0.01 to 2", source="--auto-exposure")
    if not 0 < share <= 1:
        raise InputError("must be above 0 and at most 1", path="share")
    time_ms = settled_exposure_ms(scene, level, make_renderer(backend, threads), share=share)
    if time_ms is None:
        raise InputError("the images are too dark to be exposed automatically", source=scene.source)
    return scene.with_(sensor={**scene.spec.sensor.to_mapping(), "exposure_ms": time_ms})


def settled_exposure_ms(scene: Scene, level: float, renderer: Renderer, *, share: float = 0.98) -> float | None:
    """Compute the exposure time (ms) of `auto_exposed`; None if the images are dark."""
    sensor = scene.spec.sensor
    frames = scene.with_(spp=4).frames()
    count = min(_LOOKED_AT, len(frames))
    rows = np.array([k * len(frames) // count for k in range(count)])
    images = render_windows(frames.take(rows), renderer=renderer)
    seen = np.concatenate([image.irradiance[image.parts != FRAME].astype(float) for image in images])
    charge = float(np.quantile(electrons(sensor, seen, scene.spec.wavelength_nm), share)) if seen.size else 0.0
    room = level * sensor.full_scale_dn - sensor.black_dn
    if not charge * sensor.gain > 1e-3 or room <= 0:
        return None
    return float(f"{min(sensor.time_ms * room / (charge * sensor.gain), _LONGEST_MS):.4g}")
