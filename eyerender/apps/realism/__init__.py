"""Image statistics of real and rendered pictures, for any folders of near-infrared images of eyes (docs/realism.md)."""

from __future__ import annotations

from .compare import measure_folder, realism
from .folder import FolderFigures

__all__ = ["FolderFigures", "measure_folder", "realism"]
