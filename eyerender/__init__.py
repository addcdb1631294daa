"""Near-infrared eye images through refractive corneas, with exact labels.

The names in `__init__.pyi` are the whole interface. They load their modules on first use, so `import eyerender` loads
neither Mitsuba nor OpenCV nor numba. If Dr.Jit is imported later, whoever imports it, it loads a libLLVM that renders.
"""

import lazy_loader

from .backends.hook import before_drjit


def _prepare_drjit() -> None:
    from .backends.choose import prepare_drjit

    prepare_drjit()


before_drjit(_prepare_drjit)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
