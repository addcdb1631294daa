"""Commands that show eyes and scenes: eyes, view."""

from __future__ import annotations

from typing import Literal

from ..base.errors import InputError
from ..base.storage.files import written
from .app import app
from .options import OutputFile, Result, Strict
from .output import Heed, emit

_FORMATS = (".svg", ".pdf", ".png")


@app.command(name="eyes")
def eyes(name: str | None = None, /, *, json: Result = None) -> int:
    """List the eye models of the catalogue, or print one as an eye file.

    Args:
        name: The name of a catalogue model, or an eye file.
    """
    from ..eye.catalogue import catalogue_names, load_eye

    if name is not None:
        spec = load_eye(name)
        emit({"schema": "eyerender/eye/1", "eye": spec.to_mapping()}, spec.to_yaml().rstrip(), json)
        return 0
    specs = {n: load_eye(n) for n in catalogue_names()}
    width = max(map(len, specs))
    text = "\n".join(f"{n:<{width}}  {s.description}" for n, s in specs.items())
    emit(
        {"schema": "eyerender/eyes/1", "eyes": [{"name": n, "description": s.description} for n, s in specs.items()]},
        text,
        json,
    )
    return 0


@app.command(name="view")
def view(
    what: Literal["eye", "scene"],
    name: str,
    /,
    *,
    output: OutputFile,
    eye: str | None = None,
    strict: Strict = False,
) -> int:
    """Draw an eye's section, or a scene's rig and rays, as SVG, PDF or PNG.

    Args:
        what: What to draw.
        name: For an eye, a catalogue name or an eye file; for a scene, a scene file or the name of a shipped one.
        output: The picture to write; its suffix selects the format.
        eye: Replace the scene's eye model.
    """
    if output.suffix.lower() not in _FORMATS:
        raise InputError(f"must end with one of {', '.join(_FORMATS)}", source=str(output))
    if what == "eye":
        from ..eye.catalogue import load_eye
        from ..report.eye_section import eye_section

        fig = eye_section(load_eye(name).build())
    else:
        from ..report.scene_view import scene_view

        fig = scene_view(Heed(strict).scene(name, eye=eye))
    with written(output) as file:
        fig.savefig(file, format=output.suffix[1:].lower(), dpi=150)
    print(output)
    return 0
