"""Read the image encoding of folders that `export-dataset` wrote."""

from __future__ import annotations

from pathlib import Path

from ..base.storage.files import read_json

EXPORT = "export.json"


def exported_gamma(folder: Path) -> float | None:
    """Return the encoding gamma that an export states (1 for linear images); None if it states none.

    Raises:
        InputError: export.json cannot be read.
    """
    if not (folder / EXPORT).is_file():
        return None
    image = read_json(folder / EXPORT, follow=False).get("image")
    gamma = image.get("gamma") if isinstance(image, dict) else None
    if isinstance(gamma, bool) or not isinstance(gamma, int | float) or not 0.1 <= gamma <= 10:
        return None
    return float(gamma)
