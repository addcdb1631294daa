"""Print fitted weights, or write them to the extractor's weights.json."""

from __future__ import annotations

import json
import re
from typing import Any

from eyerender.extraction.weights import FILE


def write_weights(part: str, tables: dict[str, Any], write: bool) -> None:
    """Replace tables of a part of the file, numbers to four digits; with `write` false, print them instead."""
    content: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8")) if write else {part: {}}
    content[part] |= json.loads(json.dumps(tables), parse_float=lambda text: float(f"{float(text):.4g}"))
    text = json.dumps(content, indent=1)
    text = re.sub(r"\[[^][]*\]", lambda row: re.sub(r"\s+", " ", row[0]).replace("[ ", "[").replace(" ]", "]"), text)
    if write:
        FILE.write_text(text + "\n", encoding="utf-8")
    else:
        print(text)
