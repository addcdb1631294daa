"""Commands that make images: quickstart, render."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from .app import app
from .options import Backend, EyeModel, OutputFolder, Overwrite, Result, SceneName, Seed, Strict, Threads, at_least_one
from .output import Heed, emit, progress, say


@app.command(name="render")
def render(
    scene: SceneName,
    /,
    *,
    output: OutputFolder,
    eye: EyeModel = None,
    spp: int | None = None,
    seed: Seed = None,
    surfaces: Literal["exact", "mesh"] | None = None,
    backend: Backend = "auto",
    threads: Threads = None,
    exr: bool = False,
    auto_exposure: float | None = None,
    overwrite: Overwrite = False,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Render a scene into a folder of labelled near-infrared images.

    Args:
        spp: Replace the scene's samples per pixel.
        surfaces: Render the cornea as exact surfaces or as triangles (image.surfaces).
        exr: Also write the noise-free linear irradiance as EXR.
        auto_exposure: Choose one exposure time for the whole run, so that 98 % of the pixels do not exceed this share
            of full scale (for instance 0.7; a value above 1 clips).
    """
    from ..folders.outfolder import refuse_non_empty
    from ..imaging.autoexposure import auto_exposed
    from ..imaging.folder import render_folder

    heed = Heed(strict)
    loaded = heed.scene(scene, eye=eye, spp=spp, seed=seed, surfaces=surfaces)
    refuse_non_empty(output, overwrite)
    if auto_exposure is not None:
        loaded = auto_exposed(loaded, auto_exposure, backend=backend, threads=threads)
        say(f"exposure: {loaded.spec.sensor.time_ms:g} ms")
    with progress("rendering") as steps:
        done = render_folder(
            loaded, output, backend=backend, threads=threads, overwrite=overwrite, exr=exr, progress=steps, warn=heed
        )
    emit(done, f"{done['images']} images in {output}", json, heed)
    return 0


@app.command(name="quickstart")
def quickstart(
    output: OutputFolder,
    *,
    eye: EyeModel = None,
    backend: Backend = "auto",
    threads: Threads = None,
    overwrite: Overwrite = False,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Render a small scene, extract its features, estimate gaze, and write a report."""
    from ..apps.quickstart import run_quickstart

    heed = Heed(strict)
    with progress("quickstart") as steps:
        result = run_quickstart(
            output, eye=eye, backend=backend, threads=threads, overwrite=overwrite, progress=steps, warn=heed
        )
    emit(result.to_mapping(), f"{result.to_text()}\nreport: {output / 'report.html'}", json, heed)
    return 0


@app.command(name="export-scene")
def export_scene(
    scene: SceneName,
    /,
    output: OutputFolder,
    *,
    eye: EyeModel = None,
    frame: int = 0,
    side: str | None = None,
    spp: Annotated[int, Parameter(validator=at_least_one)] = 64,
    overwrite: Overwrite = False,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Write one frame as PLY meshes and a Mitsuba XML file for the stock renderer.

    Args:
        frame: The frame of the scene, counted from 0.
        side: The eye, right or left (default: the first one that the frame shows).
        spp: Samples per pixel requested in the file; the stock path integrator needs many.
    """
    from ..imaging.folder import export_scene as write

    heed = Heed(strict)
    loaded = heed.scene(scene, eye=eye)
    data = write(loaded, output, frame=frame, side=side, spp=spp, overwrite=overwrite)
    name = data["scene"]
    emit(
        data, f"{output / name}\nrender it with any stock integrator: mitsuba -m scalar_rgb {output / name}", json, heed
    )
    return 0
