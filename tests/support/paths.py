"""Folders of the checkout, and the reference vectors in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
SCRIPTS = ROOT / "scripts"
DATA = TESTS / "data"


def load(name: str) -> Any:
    """What a JSON file of reference vectors in `tests/data` holds; `tests/data/README.md` says where each is from."""
    return json.loads((DATA / name).read_text(encoding="utf-8"))
