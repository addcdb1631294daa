"""Labelled images rendered in memory."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, overload

from ..analytic.observer import trace
from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..base.progress import Progress
from ..folders.imagefile import png_bytes, preview
from ..rig.rig import RigLike
from .capture import EyeImage, make_renderer, render_windows
from .labels import image_labels
from .renderable import RenderableFrame, RenderableFrames, RenderableSource, posed_frames

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
    frames: RenderableFrame, rig: RigLike | None = None, *, spp: int | None = None, backend: BackendChoice = "auto",
    threads: int | None = None, progress: Progress | None = None, **picture: Any,
) -> LabelledImage: ...  # fmt: skip
@overload
def render(
    frames: RenderableFrames | RenderableSource, rig: RigLike | None = None, *,
    spp: int | None = None, backend: BackendChoice = "auto",
    threads: int | None = None, progress: Progress | None = None, **picture: Any,
) -> list[LabelledImage]: ...  # fmt: skip
def render(
    frames: RenderableFrames | RenderableSource,
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
        progress: called with (images done, images in all, note) after each image.
        picture: fields of the scene that affect only its images: `image`, `sensor`, `look`, `region`, `lens`, `motion`,
            `ambient`, `seed`.

    Returns:
        One image for one frame, else a list with an image for each row.

    Raises:
        InputError: a value does not fit, or a window cannot be rendered.
        BackendError: no backend renders; the message says how to fix it.
    """
    posed = posed_frames(frames)
    for name in picture.keys() - PICTURE_FIELDS:
        raise InputError(f"changes more than the picture; allowed are {', '.join(sorted(PICTURE_FIELDS))}", path=name)
    if picture or spp is not None:
        posed = posed.of_scene(posed.scene.with_(spp=spp, **picture))
    posed = posed.seen_by(rig)
    truth = trace(posed, occluded=False)
    out = []
    for image in render_windows(posed, renderer=_renderer(backend, threads), progress=progress):
        parts = {field.name: getattr(image, field.name) for field in fields(image)}
        out.append(LabelledImage(**parts, labels=image_labels(image, truth)))
    return out[0] if isinstance(frames, RenderableFrame) else out
