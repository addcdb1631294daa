"""The eye region: materials and textures as geometry and numbers, independent of any renderer.

The names in `__init__.pyi` load their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
