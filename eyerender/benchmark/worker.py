"""A Python callable behind the protocol: `python -m eyerender.benchmark.worker module:callable [NAME]`.

The callable takes (image, request): the image as (h, w) numbers as stored, the request as the mapping that was sent. It
returns the record, {"pupil": {..}, "glints": [..]}. Its attributes `conventions` and `reports`, where it has them, are
those of the greeting. What it prints goes to stderr. In place of a callable a `registry.Command` may
stand, which is then run instead.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, TextIO

import numpy as np

from ..imagefile import read_image
from .conventions import Conventions
from .protocol import FEATURES, SCHEMA
from .registry import Command

ExtractorCallable = Callable[[Any, Mapping[str, Any]], Mapping[str, Any]]


def main(argv: list[str]) -> int:
    """Serve requests until the input ends."""
    stdout = os.dup(1)
    # Nothing that a library or the callable prints may mix with the answers.
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    extractor = load(argv[0])
    if isinstance(extractor, Command):
        if extractor.argv is None:
            raise SystemExit(extractor.missing)
        os.dup2(stdout, 1)
        os.execvp(extractor.argv[0], extractor.argv)
    answers = os.fdopen(stdout, "w", encoding="utf-8")
    greeting = {
        "schema": SCHEMA,
        "name": argv[1] if len(argv) > 1 else argv[0],
        "conventions": Conventions.of(getattr(extractor, "conventions", None)).to_mapping(),
        "reports": list(getattr(extractor, "reports", FEATURES)),
    }
    _send(answers, json.dumps(greeting))
    warm = False
    for line in sys.stdin:
        request = json.loads(line)
        try:
            image, _ = read_image(request["image"])
            if not warm:
                extractor(image, request)  # the first call loads libraries and tables
                warm = True
            wall, cpu = time.perf_counter(), time.process_time()
            record = extractor(image, request)
            spent = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
            text = json.dumps({"id": request["id"], "record": record, **spent}, default=_plain)
        except Exception as error:  # an extractor's defect on one image is that image's result
            text = json.dumps({"id": request["id"], "error": f"{type(error).__name__}: {error}"})
        _send(answers, text)
    return 0


def load(name: str) -> ExtractorCallable | Command:
    """The object behind `module:attribute.attribute`."""
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not (callable(found) or isinstance(found, Command)):
        raise TypeError(f"{name} is neither a callable nor a Command")
    return found  # type: ignore[no-any-return]


def _send(stream: TextIO, line: str) -> None:
    stream.write(line + "\n")
    stream.flush()


def _plain(value: object) -> Any:
    """NumPy's numbers and arrays as JSON knows them."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"the record holds a {type(value).__name__}, which JSON does not know")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
