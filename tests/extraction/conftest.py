"""The generator of ideal images, which lives with the scripts."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def ideal() -> ModuleType:
    path = Path(__file__).parents[2] / "scripts" / "make_ideal_images.py"
    spec = importlib.util.spec_from_file_location("make_ideal_images", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_ideal_images"] = module
    spec.loader.exec_module(module)
    return module
