"""Near-infrared eye images through refractive corneas, with exact labels.

The names in `__init__.pyi` are the whole interface. They load their modules on first use, so `import eyerender` loads
neither Mitsuba nor OpenCV nor numba. If Dr.Jit is imported later, whoever imports it, it loads a libLLVM that renders.
"""

import importlib
import inspect
from pathlib import Path

import lazy_loader

from .backends.hook import before_drjit


def _prepare_drjit() -> None:
    from .backends.choose import prepare_drjit

    prepare_drjit()


before_drjit(_prepare_drjit)
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Load a public name; a function checks its arguments."""
    if name == "torch":  # not in `__all__`, as it needs an extra
        return importlib.import_module(".torch", __name__)
    if name not in __all__:
        from .base.errors import nearest

        spaces = (one for one in __all__ if (Path(__file__).parent / one).is_dir() and name in dir(_load(one)))
        if (space := next(spaces, None)) is not None:
            raise AttributeError(f"eyerender has no {name!r}; write eyerender.{space}.{name}")
        raise AttributeError(f"eyerender has no {name!r}; {nearest(name, __all__)}dir(eyerender) lists its names")
    found = _load(name)
    if inspect.isfunction(found):
        from .base.arguments import checked

        found = globals()[name] = checked(found)
    return found
