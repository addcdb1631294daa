"""References to a user's own code: `module:name`.

Loading a reference runs the module. A reference is therefore loaded only where the user gave it (on the command line,
in Python, as an entry point), never because a file contains it.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from typing import Any

from .errors import InputError
from .storage.files import shown

_REFERENCE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


def is_reference(text: str) -> bool:
    """Return whether a text has the form `module:name`; both parts may contain dots."""
    return _REFERENCE.fullmatch(text) is not None


def load_reference(reference: str, *, source: str = "") -> Any:
    """Load the object `module:name`; the module is searched on Python's path, then in the current folder.

    Raises:
        InputError: the reference has another form, the module or name does not exist, or the import fails.
    """
    if not is_reference(reference):
        raise InputError(f"must be module:name, not {shown(reference)}", source=source)
    module, _, names = reference.partition(":")
    if "" not in sys.path:
        sys.path.append("")
    try:
        found: Any = import_module(module)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and error.name and f"{module}.".startswith(f"{error.name}."):
            raise InputError(f"there is no module {error.name!r} for {reference}", source=source) from None
        reason = f"{module} cannot be imported ({type(error).__name__}: {error})"
        raise InputError(reason, source=source) from error
    for name in names.split("."):
        try:
            found = getattr(found, name)
        except AttributeError:
            raise InputError(f"{module} has no {names}", source=source) from None
    return found
