"""Feature extractors against each other over a folder of labelled images.

Every extractor runs in a process of its own and speaks one protocol (`protocol`), so that none can harm another or the
bench; what it reports is converted from its own conventions in one place (`conventions`).
"""

from __future__ import annotations

from .conventions import Conventions
from .registry import Extractor, names, resolve
from .run import bench_extractors

__all__ = ["Conventions", "Extractor", "bench_extractors", "names", "resolve"]
