"""People: a joint distribution of eyes, pupils, lids and faces, and persons drawn from it.

The names in `__init__.pyi` load their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
