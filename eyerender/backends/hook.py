"""Set-up that must precede any import of drjit, by the package, a notebook or `import mitsuba`.

Dr.Jit reads its settings and loads a libLLVM when it is first imported, and keeps both. `import eyerender` installs
this hook, so afterwards the order of imports is free.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.abc import MetaPathFinder


class DrjitHook(MetaPathFinder):
    """Prepare the process when drjit is about to be imported; the usual finders then import it."""

    prepare: Callable[[], None] | None = None

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        """Prepare the process once; find nothing."""
        if fullname == "drjit" and self.prepare:
            prepare, self.prepare = self.prepare, None
            prepare()


HOOK = DrjitHook()


def before_drjit(prepare: Callable[[], None]) -> None:
    """Call a function once, before drjit is first imported."""
    HOOK.prepare = prepare
    sys.meta_path.insert(0, HOOK)
