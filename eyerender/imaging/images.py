"""Labelled images: frames rendered in memory, a scene rendered into a folder or exported for the stock renderer."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from ..analytic.observer import trace
from ..backends.choose import BackendChoice
from ..base.errors import InputError, Warn
from ..base.progress import Progress
from ..folders.imagefile import Writer, png_bytes, preview
from ..folders.imagefolder import FRAME, write_dataset
from ..folders.outfolder import MARKER, refuse_non_empty, staged
from ..rig.exposure import electrons
from ..rig.plausibility import is_saturated, saturation_warnings
from ..rig.rig import RigLike
from ..scene import Frame, Frames, Scene, as_frames
from ..scene.observation import EYES
from .capture import EyeImage, check_windows, make_renderer, render_job, render_windows
from .labels import image_labels, seen_labels

if TYPE_CHECKING:
    from ..rendering.renderer import Renderer

PICTURE_FIELDS = frozenset({"image", "sensor", "look", "region", "lens", "motion", "ambient", "seed"})
"""Fields of a scene that affect only its images."""

# A renderer keeps compiled kernels and scenes; a notebook needs one for each backend and number of threads.
_renderer = lru_cache(maxsize=1)(make_renderer)


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage(EyeImage):
    """A rendered image of one eye with its labels.

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


def render_folder(
    scene: Scene,
    path: str | Path,
    *,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    overwrite: bool = False,
    exr: bool = False,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> dict[str, Any]:
    """Render a scene into a folder of labelled images (docs/formats.md); on an error, nothing is left.

    Args:
        scene: the scene.
        path: the folder to write.
        backend: the render backend.
        threads: total number of processor threads; None: all.
        overwrite: replace the contents of the folder.
        exr: also write the noise-free linear irradiance as EXR.
        progress: called with (images done, images in all, "").
        warn: called for saturated images before the folder is put in place; if it raises, nothing is written. Warnings
            that need no rendering are in `Scene.warnings`.

    Returns:
        A mapping (schema eyerender/render/1): path, number of images, warnings of both kinds.
    """
    warnings = scene.warnings()
    refuse_non_empty(path, overwrite)  # before the work, not after it
    frames = scene.frames()
    truth = trace(frames)
    records = list(truth.records())
    lines: list[dict[str, Any]] = []
    saturated = 0
    spec = scene.spec
    with staged(path, overwrite=overwrite) as folder, Writer() as writer:
        (folder / "images").mkdir()
        (folder / "masks").mkdir()
        for image in render_windows(frames, backend=backend, threads=threads, progress=progress):
            line: dict[str, Any] = {
                "file_name": f"images/{image.name}.png",
                "mask_file_name": f"masks/{image.name}.png",
                "window_px": dict(zip(("x0", "y0", "width", "height"), image.window, strict=True)),
                "bit_depth": spec.sensor.bit_depth,
                "gamma": spec.sensor.gamma,
                "records": [records[image.row]],
                "labels": seen_labels(image, truth),
                "parameters": {
                    "eye_model": scene.eye_name,
                    "pupil_diameter_mm": scene.stop_diameter_mm(records[image.row]["eye"]),
                    "wavelength_nm": spec.wavelength_nm,
                    "spp": spec.image.spp,
                    "seed": spec.seed,
                    "camera": image.camera,
                    **scene.person_numbers(records[image.row]["eye"]),
                },
            }
            writer.put(folder / line["file_name"], image.counts)
            writer.put(folder / line["mask_file_name"], image.parts)
            if exr:
                from ..rendering.scene.exr import write_exr

                write_exr(folder / "images" / f"{image.name}.exr", image.irradiance)
            lines.append(line)
            saturated += is_saturated(image.counts, spec.sensor)
        found = saturation_warnings(saturated, len(lines), scene.source)
        if warn is not None:
            warn(found)
        statistics = {"images": len(lines), "images_saturated": saturated, "observations": len(truth)}
        write_dataset(folder, lines, spec=spec.to_mapping(), digest=scene.digest(), statistics=statistics)
    return {
        "schema": "eyerender/render/1",
        "path": str(path),
        "images": len(lines),
        "warnings": [warning.to_mapping() for warning in (*warnings, *found)],
    }


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


def export_scene(
    scene: Scene, path: str | Path, *, frame: int = 0, side: str | None = None, spp: int = 64, overwrite: bool = False
) -> dict[str, Any]:
    """Write one frame as PLY meshes and a Mitsuba XML file, which the stock `mitsuba` command renders directly.

    Args:
        scene: the scene.
        path: the folder to write; on an error, nothing is left.
        frame: the frame, counted from 0.
        side: the eye, right or left; by default the first one that the frame shows.
        spp: samples per pixel requested in the file.
        overwrite: replace the contents of the folder.

    Returns:
        A mapping (schema eyerender/export-scene/1): path, name of the XML file, names of all files.

    Raises:
        InputError: there is no such frame or eye, the scene cannot be rendered, or the folder is not empty.
    """
    from ..rendering.output.export import export_scene as write_job

    check_windows(scene)
    frames = scene.frames()
    if side is not None and side not in EYES:
        raise InputError("must be right or left", source="--side")
    index = frames.index
    rows = [r for r in range(len(frames)) if index.frame[r] == frame and side in (None, EYES[index.eye[r]])]
    if not rows:
        shown = " and ".join(scene.spec.subject.eyes)
        raise InputError(f"the scene has frames 0 to {int(index.frame.max())}, eyes {shown}", source="--frame")
    with staged(path, overwrite=overwrite) as folder:
        name = write_job(render_job(frames, rows[0]), folder, spp=spp).name
    made = Path(path)
    files = sorted(str(p.relative_to(made)) for p in made.rglob("*") if p.is_file() and p.name != MARKER)
    return {"schema": "eyerender/export-scene/1", "path": str(path), "scene": name, "files": files}
