"""Commands that export a scene to other programs: export-scene."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from .app import app
from .options import EyeModel, OutputFolder, Overwrite, Result, SceneName, Strict, at_least_one
from .output import Heed, emit


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
