"""The eye tracker's hardware: cameras, lights, screen, sensor, lens, and light from elsewhere.

The names in `__init__.pyi` load their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
