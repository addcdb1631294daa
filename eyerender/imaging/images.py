"""Labelled images rendered in memory, and the automatic exposure of a scene's images."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from ..analytic.observer import trace
from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..base.progress import Progress
from ..folders.imagefile import png_bytes, preview
from ..rig.exposure import electrons
from ..rig.rig import RigLike
from ..scene import Frame, Frames, Scene, as_frames
from ..scene.parts import FRAME
from .capture import EyeImage, make_renderer, render_windows
from .labels import image_labels

if TYPE_CHECKING:
    from ..rendering.renderer import Renderer

PICTURE_FIELDS = frozenset({"image", "sensor", "look", "region", "lens", "motion", "ambient", "seed"})
"""Fields of a scene that affect only its images."""

# A renderer keeps compiled kernels and scenes; a notebook needs one for each backend and number of threads.
_renderer = lru_cache(maxsize=1)(make_renderer)


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage(EyeImage):
    """A rendered image of one eye with its labels.

    >>> image = er.render(er.load_scene("headset").frames()[0])  # doctest: +SKIP
    >>> image.irradiance.max()  # doctest: +SKIP

    Attributes:
        labels: labels as in a dataset (docs/formats.md): pupil, iris, glints, lids, points in space.
    """

    labels: dict[str, Any]

    def _repr_png_(self) -> bytes:
        """Encode the image as PNG, for notebooks."""
        return png_bytes(preview(self.counts, self.scene.spec.sensor.full_scale_dn))


@overload
def render(
    frames: Frame, rig: RigLike | None = None, *, spp: int | None = None, backend: BackendChoice = "auto",
    threads: int | None = None, progress: Progress | None = None, **picture: Any,
) -> LabelledImage: ...  # fmt: skip
@overload
def render(
    frames: Frames | Scene, rig: RigLike | None = None, *, spp: int | None = None, backend: BackendChoice = "auto",
    threads: int | None = None, progress: Progress | None = None, **picture: Any,
) -> list[LabelledImage]: ...  # fmt: skip
def render(
    frames: Frames | Scene,
    rig: RigLike | None = None,
    *,
    spp: int | None = None,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
    **picture: Any,
) -> LabelledImage | list[LabelledImage]:
    """Render frames in memory, one window per eye.

    >>> image = er.render(er.load_scene("headset").frames()[0], spp=64)  # doctest: +SKIP

    Args:
        frames: one frame (`frames[0]`), several, or a scene for all of its frames.
        rig: replaces the rig of the frames.
        spp: samples per pixel.
        backend: the render backend.
        threads: number of processor threads for rendering; None: all.
        progress: called with (done, total, "") after each image.
        picture: fields of the scene that affect only its images: `image`, `sensor`, `look`, `region`, `lens`, `motion`,
            `ambient`, `seed`.

    Returns:
        One image for one frame, else a list with an image for each row.

    Raises:
        InputError: a value does not fit, or a window cannot be rendered.
        BackendError: no backend renders; the message says how to fix it.
    """
    frames = as_frames(frames)
    for name in picture.keys() - PICTURE_FIELDS:
        raise InputError(f"changes more than the picture; allowed are {', '.join(sorted(PICTURE_FIELDS))}", path=name)
    if picture or spp is not None:
        frames = frames.of_scene(frames.scene.with_(spp=spp, **picture))
    frames = frames.seen_by(rig)
    truth = trace(frames)
    out = []
    for image in render_windows(frames, renderer=_renderer(backend, threads), progress=progress):
        parts = {field.name: getattr(image, field.name) for field in fields(image)}
        out.append(LabelledImage(**parts, labels=image_labels(image, truth)))
    return out[0] if isinstance(frames, Frame) else out


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
    return float(f"{min(sensor.exposure_ms * room / (charge * sensor.gain), _LONGEST_MS):.4g}")
