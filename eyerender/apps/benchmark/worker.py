"""Run a Python callable behind the protocol: `python -m eyerender.apps.benchmark.worker module:callable [NAME]`.

`onnx:FILE` in place of the callable runs a network (`network.py`).

With `--check` first, the callable is only loaded: the files of its code are printed as a JSON list, or the exit code is
2 if there is no such callable.

The callable follows `protocol.Extractor`; its output goes to stderr. If the name refers to a `registry.Command`, that
command is run instead.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any, TextIO

import numpy as np

from ...base.errors import InputError
from ...base.references import load_reference
from ...folders.imagefile import read_any_image
from .protocol import FEATURES, SCHEMA, Conventions, Extractor
from .registry import PREFIX, Command


def main(argv: list[str]) -> int:
    """Serve requests until the input ends, or check a reference."""
    stdout = os.dup(1)
    # Output of libraries or the callable must not mix with the answers.
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    if argv[0] == "--check":
        return _check(argv[1], os.fdopen(stdout, "w", encoding="utf-8"))
    try:
        found = _loaded(argv[0])
    except InputError as error:
        raise SystemExit(str(error)) from None
    if isinstance(found, Command):
        if found.argv is None:
            raise SystemExit(found.missing)
        os.dup2(stdout, 1)
        os.execvp(found.argv[0], found.argv)
    if not callable(found):
        raise SystemExit(f"{argv[0]} is neither a callable nor a Command")
    extractor: Extractor = found
    answers = os.fdopen(stdout, "w", encoding="utf-8")
    greeting = {
        "schema": SCHEMA,
        "name": argv[1] if len(argv) > 1 else argv[0],
        "conventions": Conventions.of(getattr(extractor, "conventions", None)).to_mapping(),
        "reports": list(getattr(extractor, "reports", FEATURES)),
        "warms_up": True,
    }
    _send(answers, json.dumps(greeting))
    warm = False
    for line in sys.stdin:
        request = json.loads(line)
        try:
            image, _, _ = read_any_image(request["image"])
            if not warm:
                extractor(image, request)  # the first call loads libraries and tables
                warm = True
            wall, cpu = time.perf_counter(), time.process_time()
            record = extractor(image, request)
            spent = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
            text = json.dumps({"id": request["id"], "record": record, **spent}, default=_plain)
        except Exception as error:  # an error of the extractor on one image is that image's result
            text = json.dumps({"id": request["id"], "error": f"{type(error).__name__}: {error}"})
        _send(answers, text)
    return 0


def _check(reference: str, answers: TextIO) -> int:
    """Load a callable, and print the files of its module and of other modules outside installed packages."""
    try:
        found = _loaded(reference)
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    if not callable(found) and not isinstance(found, Command):
        sys.stderr.write(f"{reference} is neither a callable nor a Command\n")
        return 2
    if reference.startswith(PREFIX):
        _send(answers, json.dumps([os.path.abspath(reference.removeprefix(PREFIX))]))
        return 0
    installed = (sys.prefix, sys.base_prefix)
    files = {
        name: file
        for name, module in list(sys.modules.items())
        if isinstance(file := getattr(module, "__file__", None), str)
    }
    own = {
        file for name, file in files.items() if name == reference.partition(":")[0] or not file.startswith(installed)
    }
    _send(answers, json.dumps(sorted(os.path.abspath(file) for file in own)))
    return 0


def _loaded(reference: str) -> Any:
    """Load a network or `module:callable`."""
    if reference.startswith(PREFIX):
        from .network import load_network

        return load_network(reference.removeprefix(PREFIX))
    return load_reference(reference)


def _send(stream: TextIO, line: str) -> None:
    stream.write(line + "\n")
    stream.flush()


def _plain(value: object) -> Any:
    """Convert NumPy's numbers and arrays to JSON types."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"the record holds a {type(value).__name__}, which JSON cannot represent")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
