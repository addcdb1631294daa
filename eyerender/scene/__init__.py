"""Scenes (who looks where, and which rig and camera settings observe it), their frames with poses, and observations.

The names in `__init__.pyi` load their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
