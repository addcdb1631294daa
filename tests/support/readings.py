"""Find the functions of the package that read files: in its sources, and while it runs."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import eyerender

PACKAGE = Path(eyerender.__file__).resolve().parent
# The package's own openers, which read regular files of a limited size.
OPENERS = {"opened", "read_bytes", "read_text", "read_json", "read_yaml", "read_csv", "mapped_array", "JsonLines.index"}
# Calls of libraries that open a file by its path, or read one that is open, by the name of the module.
LIBRARIES = {
    "np": {"load", "loadtxt", "genfromtxt", "fromfile", "memmap", "lib.format.read_array", "lib.format.open_memmap"},
    "npy": {"open_memmap", "read_array"},
    "cv2": {"imread", "imreadmulti", "VideoCapture", "FileStorage"},
    "Image": {"open"},
    "imageio": {"imread", "get_reader"},
    "trimesh": {"load", "load_scene", "load_mesh"},
    "mi": {"Bitmap", "load_file"},
    "parquet": {"read_table", "ParquetFile"},
    "pickle": {"load", "loads", "Unpickler"},
    "os": {"open", "fdopen"},
    "io": {"open", "FileIO"},
    "tarfile": {"open"},
    "gzip": {"open"},
    "zipfile": {"ZipFile"},
    "json": {"load"},
    "ElementTree": {"parse"},
    "mmap": {"mmap"},
}


@cache
def calls() -> tuple[tuple[str, ast.Call], ...]:
    """Every call in the package, with the dotted name of the function or method that makes it."""

    def walk(node: ast.AST, name: str) -> Iterator[tuple[str, ast.Call]]:
        for child in ast.iter_child_nodes(node):
            named = isinstance(child, ast.FunctionDef | ast.ClassDef)
            if isinstance(child, ast.Call):
                yield name, child
            yield from walk(child, f"{name}.{child.name}" if named else name)  # type: ignore[attr-defined]

    paths = (p for p in sorted(PACKAGE.rglob("*.py")) if "data" not in p.relative_to(PACKAGE).parts)
    return tuple(found for path in paths for found in walk(ast.parse(path.read_text(encoding="utf-8")), _module(path)))


def readers() -> set[str]:
    """Dotted names of the functions that call an opener, and `Type.load` of the types that are read from a path."""
    texts = [(name, ast.unparse(call.func)) for name, call in calls()]
    return {name for name, text in texts if text in OPENERS} | {
        text for _, text in texts if re.fullmatch(r"[A-Z]\w*\.load", text)
    }


def other_ways() -> set[str]:
    """Calls that read a file past the package's openers, as `function: call`."""
    return {f"{name}: {ast.unparse(call.func)}" for name, call in calls() if _is_other_way(call)}


def _is_other_way(call: ast.Call) -> bool:
    owner, _, name = ast.unparse(call.func).partition(".")
    if name in LIBRARIES.get(owner, ()):
        return True
    function = ast.unparse(call.func).rpartition(".")[2]
    if function == "open":
        given = [*call.args[:2], *(k.value for k in call.keywords if k.arg == "mode")]
        modes = {str(a.value) for a in given if isinstance(a, ast.Constant)}
        return not modes & {"w", "x", "a", "wb", "xb", "ab"}  # these write only
    return isinstance(call.func, ast.Attribute) and function in ("read_text", "read_bytes")


def _module(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def called(run: Callable[[], Any]) -> set[str]:
    """Dotted names of the functions of the package that are called while something runs, with `Type.load`."""
    codes, types = set(), set()

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call":
            codes.add(frame.f_code)
            if frame.f_code.co_name == "load" and isinstance(frame.f_locals.get("cls"), type):
                types.add(f"{frame.f_locals['cls'].__name__}.load")

    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
    ours = [(code, Path(code.co_filename)) for code in codes if Path(code.co_filename).is_relative_to(PACKAGE)]
    return types | {f"{_module(path)}.{code.co_qualname.replace('.<locals>', '')}" for code, path in ours}
