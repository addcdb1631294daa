"""Folders of the checkout, and the reference vectors in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "scripts"
TOOLS = SCRIPTS / "tools"
DATA = ROOT / "tests" / "data"
BARE_HEAD_MOUNTED = str(DATA / "bare_head_mounted.yaml")  # the shipped scene as a bare globe


def load(name: str) -> Any:
    """What a JSON file of reference vectors in `tests/data` holds; `tests/data/README.md` says where each is from."""
    return json.loads((DATA / name).read_text(encoding="utf-8"))
