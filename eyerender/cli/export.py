"""Commands that hand a scene to other programs: export-scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from ..errors import InputError
from .app import app
from .options import EyeModel, Overwrite, Result, Strict, positive
from .output import Heed, emit


@app.command(name="export-scene")
def export_scene(
    scene: str,
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *,
    eye: EyeModel = None,
    frame: int = 0,
    side: str | None = None,
    spp: int = 64,
    overwrite: Overwrite = False,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Write one frame as PLY meshes and a Mitsuba XML file for the stock renderer.

    Args:
        scene: A scene file, or the name of a shipped scene.
        folder: The folder to write.
        frame: The frame of the scene, counted from 0.
        side: The eye, right or left (default: the first one that the frame shows).
        spp: Samples per pixel requested in the file; the stock path integrator needs many.
    """
    from ..capture import check_windows, render_job
    from ..observation import EYES
    from ..outfolder import MARKER, staged
    from ..rendering.export import export_scene as write_scene
    from ..scene import load_scene

    positive("--spp", spp)
    heed = Heed(strict)
    loaded = load_scene(scene, eye=eye)
    heed(loaded.warnings())
    check_windows(loaded)
    frames = loaded.frames()
    if side is not None and side not in EYES:
        raise InputError("must be right or left", source="--side")
    index = frames.index
    rows = [r for r in range(len(frames)) if index.frame[r] == frame and side in (None, EYES[index.eye[r]])]
    if not rows:
        shown = " and ".join(loaded.spec.subject.eyes)
        raise InputError(f"the scene has frames 0 to {int(index.frame.max())}, eyes {shown}", source="--frame")
    with staged(folder, overwrite=overwrite) as stage:
        written = write_scene(render_job(frames, rows[0]), stage, spp=spp)
        name = written.name
    files = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name != MARKER)
    data = {"schema": "eyerender/export-scene/1", "path": str(folder), "scene": name, "files": files}
    emit(
        data, f"{folder / name}\nrender it with any stock integrator: mitsuba -m scalar_rgb {folder / name}", json, heed
    )
    return 0
