"""The catalogue of eyes: E1 to E5, and any eye file.

E1 to E5 lie beside this module; each value carries its source. A package of eyerender may bring eyes of its own in a
folder `eyes/`. The catalogue finds them by their files, so it knows their names and imports nothing from there.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from ...errors import InputError
from ..spec import EyeSpec

FOLDER = Path(__file__).parent
_PACKAGE = FOLDER.parents[1]


def catalogue_names() -> tuple[str, ...]:
    """The names of the catalogue, in order, those that other packages bring among them."""
    return tuple(sorted(catalogue_files()))


@cache
def catalogue_files() -> Mapping[str, Path]:
    """The eye file of each name."""
    return {path.stem: path for path in (*_PACKAGE.glob("*/eyes/*.yaml"), *FOLDER.glob("*.yaml"))}


def load_eye(name_or_path: str | Path) -> EyeSpec:
    """An eye of the catalogue by its name, or an eye file; raises `InputError` for what is neither."""
    if isinstance(name_or_path, str) and name_or_path in catalogue_names():
        return _shipped(name_or_path)
    path = Path(name_or_path)
    # os.path finds nothing under a name that no file can have, where Path raises.
    if path.suffix not in (".yaml", ".yml") and not os.path.exists(path):
        raise InputError(f"no such eye; the catalogue holds {', '.join(catalogue_names())}", source=str(name_or_path))
    return EyeSpec.load(path)


@cache
def _shipped(name: str) -> EyeSpec:
    return EyeSpec.load(catalogue_files()[name])
