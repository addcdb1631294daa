"""What must happen before drjit is imported, whoever imports it: the package, a notebook, `import mitsuba`.

Dr.Jit reads its settings and loads a libLLVM when it is first imported, and keeps both. `import eyerender` installs
this hook, so afterwards the order of imports is free.
"""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder

from .libraries import is_testing


class DrjitHook(MetaPathFinder):
    """Prepare the process when drjit is about to be imported; the usual finders then import it."""

    armed = True

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        """Prepare the process once; find nothing."""
        if fullname == "drjit" and self.armed and not is_testing():
            self.armed = False
            from .choose import prepare_drjit

            prepare_drjit()


HOOK = DrjitHook()


def install_hook() -> None:
    """Put the hook before the other finders."""
    if HOOK not in sys.meta_path:
        sys.meta_path.insert(0, HOOK)
