"""Dataset runs: from a spec to a labelled dataset, on one machine or many.

`spec` and `plan` define sample i, `maker` makes it, `shard` and `run` write it, `validate` and `export` read it.

The names in `__init__.pyi` load their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
