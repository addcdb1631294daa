"""Write the folder of a fit: one eye file per eye, and fit.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.storage.files import write_json, write_text
from ..eye.spec import EyeSpec
from ..folders.outfolder import staged
from .fit import EyeFit

SCHEMA = "eyerender/fit-eye/1"
FIT = "fit.json"


def write_fits(output: str | Path, fits: Sequence[EyeFit], *, overwrite: bool = False) -> dict[str, Any]:
    """Write right.yaml, left.yaml and fit.json into a folder; return the content of fit.json.

    An eye that fits the features, but is physically impossible, has no file: its `file` is null, with a `file_reason`.

    Raises:
        InputError: the folder is not empty.
    """
    specs: dict[str, EyeSpec] = {}
    reasons: dict[str, str | None] = {}
    for fit in fits:
        try:
            specs[fit.eye], reasons[fit.eye] = fit.spec, None
        except InputError as error:
            reasons[fit.eye] = str(error)
    eyes = [
        {**fit.to_mapping(), "file": f"{fit.eye}.yaml" if fit.eye in specs else None, "file_reason": reasons[fit.eye]}
        for fit in fits
    ]
    found = {"schema": SCHEMA, "eyes": eyes}
    with staged(output, overwrite=overwrite) as folder:
        for eye, spec in specs.items():
            write_text(folder / f"{eye}.yaml", spec.to_yaml())
        write_json(folder / FIT, found)
    return found
