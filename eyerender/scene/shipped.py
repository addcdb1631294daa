"""Load scene files by path, or by the name of one that comes with the package."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from ..base.errors import InputError, nearest
from ..base.spec import read_yaml
from ..rig.imaging import Surfaces
from .scene import Scene
from .spec import DATASET_KIND, NOT_A_SCENE, SceneSpec


def shipped_scenes() -> dict[str, Path]:
    """Return the scenes that come with the package, as a mapping from name to file.

    >>> "headset" in er.shipped_scenes()
    True
    """
    return {name: path for name, path in shipped_files().items() if not is_shipped_dataset(path)}


@cache
def is_shipped_dataset(path: Path) -> bool:
    """Return whether a shipped file is a dataset, by the line that says so: parsing all files takes a second."""
    return f"\nkind: {DATASET_KIND}\n" in path.read_text(encoding="utf-8")


def shipped_files() -> dict[str, Path]:
    """Return the scenes and dataset specs that come with the package, as a mapping from name to file."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "data" / "scenes", package.parent / "scenes"):
        if folder.is_dir():
            return {p.stem: p for p in sorted(folder.glob("*.yaml"))}
    return {}


def is_dataset(path: Path) -> bool:
    """Return whether a YAML file declares itself a dataset spec (`kind: dataset`) rather than a scene."""
    try:
        return read_yaml(path).get("kind") == DATASET_KIND
    except InputError:
        return False


def refuse_folder(path: Path, wanted: str) -> None:
    """Raise an `InputError` if a folder is given instead of a file; the message names the file probably meant."""
    if not os.path.isdir(path):
        return
    hint = ""
    if (path / "scene.yaml").is_file():
        hint = f"; give {path / 'scene.yaml'}"
    elif (path / "images").is_dir():
        hint = f"; the images that were made are in {path / 'images'}"
    raise InputError(f"is a folder; give {wanted}{hint}", source=str(path))


def load_scene(
    scene: str | Path,
    *,
    eye: str | None = None,
    spp: int | None = None,
    seed: int | None = None,
    surfaces: Surfaces | None = None,
) -> Scene:
    """Load a scene from a file, or by the bare name of a shipped one.

    >>> len(er.load_scene("headset").rig.lights)
    8

    Args:
        scene: path of a YAML file, or a shipped scene's name.
        eye: replaces the scene's eye model (a catalogue name or an eye file).
        spp: replaces the samples per pixel.
        seed: replaces the seed.
        surfaces: replaces the rendering method of the cornea.

    Raises:
        InputError: one line that names the file and the key, or the wrong option.
    """
    path = Path(scene)
    shipped = shipped_scenes()
    if not os.path.isfile(path):
        if str(scene) in shipped:
            path = shipped[str(scene)]
        elif str(scene) in shipped_files():
            raise InputError(NOT_A_SCENE, source=str(scene))
        elif path.suffix not in (".yaml", ".yml") and not os.path.exists(path):
            near = nearest(str(scene), shipped)
            raise InputError(f"no such scene file; {near}shipped scenes: {', '.join(shipped)}", source=str(scene))
    refuse_folder(path, "a scene file, or the name of a shipped scene")
    spec = SceneSpec.load(path).with_image(spp=spp, surfaces=surfaces)
    if seed is not None:
        spec = spec.replaced("--seed", {"seed": seed})
    return Scene.of(spec, base=path.parent, eye=eye, source=str(path))
