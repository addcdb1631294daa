"""What all tests share.

The backend is chosen before any test module is imported: Dr.Jit loads a libLLVM when mitsuba is first imported, and
keeps it. Without a backend the tests that render are skipped on a developer's machine and fail in continuous
integration.
"""

from __future__ import annotations

import os
import signal

from eyerender.backends.choose import choose_backend
from eyerender.errors import BackendError

# A shell that starts the suite in the background ignores Ctrl-C for it, and the processes that tests interrupt would
# inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

try:
    choose_backend("llvm")
except BackendError:
    if os.environ.get("CI"):
        raise
