"""The catalogue of eyes: E1 to E5 of the complexity study, its variants, and any eye file.

Files live beside this module; each value carries its source.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from ...errors import InputError
from ..spec import EyeSpec

FOLDER = Path(__file__).parent


def catalogue_names() -> tuple[str, ...]:
    """The names of the catalogue, in order."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))


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
    return EyeSpec.load(FOLDER / f"{name}.yaml")
