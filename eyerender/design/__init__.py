"""Rig design: information about gaze (Fisher), fits of eyes to features, and eye safety.

The names in `__init__.pyi` load their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
