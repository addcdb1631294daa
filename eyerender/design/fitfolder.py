"""Write the folder of a fit: one eye file per eye, and fit.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.storage.files import write_json, write_text
from ..folders.outfolder import staged
from .fit import EyeFit

SCHEMA = "eyerender/fit-eye/1"
FIT = "fit.json"


def write_fits(output: str | Path, fits: Sequence[EyeFit], *, overwrite: bool = False) -> dict[str, Any]:
    """Write right.yaml, left.yaml and fit.json into a folder; return the content of fit.json.

    Raises:
        InputError: the folder is not empty.
    """
    found = {"schema": SCHEMA, "eyes": [{**fit.to_mapping(), "file": f"{fit.eye}.yaml"} for fit in fits]}
    with staged(output, overwrite=overwrite) as folder:
        for fit in fits:
            write_text(folder / f"{fit.eye}.yaml", fit.spec.to_yaml())
        write_json(folder / FIT, found)
    return found
