"""Import libraries that read a file of the current folder when they are imported: that folder may be a stranger's."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType


def imported_apart(name: str, file: str) -> ModuleType:
    """Import a library that would read `file` of the current folder; it does not.

    Only where there is such a file, this process is in the package's folder meanwhile.
    """
    if name in sys.modules or not os.path.lexists(file):
        return import_module(name)
    here = os.open(".", os.O_RDONLY)
    try:
        os.chdir(Path(__file__).parent)
        return import_module(name)
    finally:
        os.fchdir(here)
        os.close(here)
