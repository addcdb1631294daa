"""What all tests share.

The backend is chosen before any test module is imported: Dr.Jit loads a libLLVM when mitsuba is first imported, and
keeps it. Without a backend the tests that render are skipped on a developer's machine and fail in continuous
integration.
"""

from __future__ import annotations

import os

from eyerender.errors import BackendError
from eyerender.rendering.backend import choose_backend

try:
    choose_backend("llvm")
except BackendError:
    if os.environ.get("CI"):
        raise
