"""Near-infrared eye images through refractive corneas, with exact labels.

The names in `__init__.pyi` are the whole interface. They load their modules on first use, so `import eyerender` loads
neither Mitsuba nor OpenCV nor numba. A hook sees to it that Dr.Jit, whenever it is imported later, loads a libLLVM that
renders.
"""

import lazy_loader

from .backends.hook import install_hook

install_hook()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
