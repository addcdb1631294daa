"""A scene rendered into a folder of labelled images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .analytic.observer import trace
from .backends.choose import BackendChoice
from .capture import render_windows
from .errors import Warn
from .imagefile import write_png
from .imagefolder import write_dataset
from .labels import seen_labels
from .outfolder import refuse_non_empty, staged
from .plausibility import is_saturated, saturation_warnings
from .progress import Progress
from .scene import Scene


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
    """Render a scene into a folder of labelled images (docs/formats.md); complete or not at all.

    `warn` hears of saturated images before the folder is put in place; if it raises, nothing is written. What can be
    said of the scene beforehand is in `Scene.warnings`.

    Returns:
        What was written: schema eyerender/render/1, path, number of images, warnings of both kinds.
    """
    warnings = scene.warnings()
    refuse_non_empty(path, overwrite)  # before the work, not after it
    frames = scene.frames()
    truth = trace(frames)
    records = list(truth.records())
    lines: list[dict[str, Any]] = []
    saturated = 0
    spec = scene.spec
    with staged(path, overwrite=overwrite) as folder:
        (folder / "images").mkdir()
        (folder / "masks").mkdir()
        for image in render_windows(frames, backend=backend, threads=threads, progress=progress):
            line: dict[str, Any] = {
                "file_name": f"images/{image.name}.png",
                "mask_file_name": f"masks/{image.name}.png",
                "window_px": dict(zip(("x0", "y0", "width", "height"), image.window, strict=True)),
                "bit_depth": spec.sensor.bit_depth,
                "records": [records[image.row]],
                "labels": seen_labels(image, truth),
                "parameters": {
                    "eye_model": scene.eye_spec.name,
                    "pupil_diameter_mm": scene.pupil_diameter_mm,
                    "wavelength_nm": spec.wavelength_nm,
                    "spp": spec.image.spp,
                    "seed": spec.seed,
                    "camera": image.camera,
                },
            }
            write_png(folder / line["file_name"], image.counts)
            write_png(folder / line["mask_file_name"], image.parts)
            if exr:
                from .rendering.exr import write_exr

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
