"""The catalogue of eyes: E1 to E5, and any eye file.

The files of E1 to E5 are beside this module; each value has its source. Other packages of eyerender may provide eyes in
a folder `eyes/`. The catalogue finds these files by name and imports nothing from there.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from ...base.errors import InputError, nearest
from ..spec import EyeSpec

FOLDER = Path(__file__).parent
_PACKAGE = FOLDER.parents[1]


def catalogue_names() -> tuple[str, ...]:
    """Return the names of the catalogue, sorted, including those from other packages."""
    return tuple(sorted(catalogue_files()))


@cache
def catalogue_files() -> Mapping[str, Path]:
    """Return the path of the eye file of each name."""
    return {path.stem: path for path in (*_PACKAGE.glob("**/eyes/*.yaml"), *FOLDER.glob("*.yaml"))}


def load_eye(name_or_path: str | Path) -> EyeSpec:
    """Load an eye of the catalogue by its name, or an eye file.

    >>> er.load_eye("E3").name
    'E3'

    Raises:
        InputError: there is no such name and no such file.
    """
    if isinstance(name_or_path, str) and name_or_path in catalogue_names():
        return _shipped(name_or_path)
    if Path(name_or_path).suffix not in (".yaml", ".yml"):
        refuse_unknown(str(name_or_path))
    return EyeSpec.load(Path(name_or_path))


def refuse_unknown(name: str) -> None:
    """Raise InputError if a name is neither one of the catalogue nor that of a file."""
    names = catalogue_names()
    # For a name that no file can have, os.path reports that nothing exists, while Path raises.
    if name not in names and not os.path.exists(name):
        reason = f"no such eye; {nearest(name, names)}the catalogue holds {', '.join(names)}"
        raise InputError(reason, source=name)


@cache
def _shipped(name: str) -> EyeSpec:
    return EyeSpec.load(catalogue_files()[name])
