"""Look into a dataset: what it contains, what is wrong or unusual, and how it differs from another one."""

from __future__ import annotations

from .inspect import inspect

__all__ = ["inspect"]
