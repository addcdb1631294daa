"""A scene written to a folder: rendered with its labels, or exported for the stock renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..analytic.observer import trace
from ..backends.choose import BackendChoice
from ..base.arrays import finite_or_none
from ..base.errors import InputError, Warn
from ..base.progress import Progress
from ..folders.imagefile import Writer
from ..folders.imagefolder import write_dataset
from ..folders.outfolder import MARKER, refuse_non_empty, staged
from ..rig.plausibility import is_saturated, saturation_warnings
from ..scene import Scene
from ..scene.observation import EYES
from .capture import check_windows, render_job, render_windows
from .labels import image_labels
from .lines import image_line


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

    >>> er.render_folder(er.load_scene("headset"), "out")  # doctest: +SKIP

    Args:
        scene: the scene.
        path: the folder to write.
        backend: the render backend.
        threads: total number of processor threads; None: all.
        overwrite: replace the contents of the folder.
        exr: also write the noise-free linear irradiance as EXR.
        progress: called with (images done, images in all, note).
        warn: called for saturated images before the folder is put in place; if it raises, nothing is written. Warnings
            that need no rendering are in `Scene.warnings`.

    Returns:
        A mapping (schema eyerender/render/1): path, number of images, warnings of both kinds.
    """
    warnings = scene.warnings()
    refuse_non_empty(path, overwrite)  # before the work, not after it
    check_windows(scene)
    frames = scene.frames()
    truth = trace(frames, occluded=False)
    records = list(truth.records())
    lines: list[dict[str, Any]] = []
    saturated = 0
    spec = scene.spec
    worn = spec.subject.spectacles is not None
    with staged(path, overwrite=overwrite) as folder, Writer() as writer:
        for kind in ("images", "masks", *(["lens_reflections"] if worn else [])):
            (folder / kind).mkdir()
        for image in render_windows(frames, backend=backend, threads=threads, progress=progress):
            stored = {"timestamp_s": finite_or_none(truth.index.timestamp_s[image.row])}
            line = image_line(scene, records[image.row], image.window, image_labels(image, truth), sample=stored)
            line |= {"file_name": f"images/{image.name}.png", "mask_file_name": f"masks/{image.name}.png"}
            writer.put(folder / line["file_name"], image.counts)
            writer.put(folder / line["mask_file_name"], image.parts)
            if worn:
                line["lens_reflection_mask_file_name"] = f"lens_reflections/{image.name}.png"
                writer.put(folder / line["lens_reflection_mask_file_name"], image.lens_reflections)
            if exr:
                from ..rendering.scene.exr import write_exr

                write_exr(folder / "images" / f"{image.name}.exr", image.irradiance)
            lines.append(line)
            saturated += is_saturated(image.counts, spec.sensor)
        found = saturation_warnings(saturated, len(lines), scene.source, scene.exposure_excess)
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


def export_scene(
    scene: Scene, path: str | Path, *, frame: int = 0, side: str | None = None, spp: int = 64, overwrite: bool = False
) -> dict[str, Any]:
    """Write one frame as PLY meshes and a Mitsuba XML file, which the stock `mitsuba` command renders directly.

    >>> er.export_scene(er.load_scene("headset"), "exported")  # doctest: +SKIP

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
