"""The extractor's compiled functions: all are compiled beforehand, and their machine code is kept and removed."""

from __future__ import annotations

import os
import time

import make_ideal_images as ideal
from eyerender.base.jit import argument_types, functions, used
from eyerender.extraction import extract
from eyerender.extraction.compile import compile_all

CONDITIONS = ("eight-glints", "lid", "jpeg")


def images():
    for condition in CONDITIONS:
        drawing = ideal.draw(condition, 3)
        yield drawing.image, drawing.parameters["bit_depth"]


def test_everything_is_compiled_beforehand():
    """Extraction must compile nothing more, neither another function nor one for other types."""
    compile_all()
    before = {one.__name__: len(one.signatures) for one in functions()}
    assert min(before.values()) > 0, before
    for image, depth in images():
        extract(image, bit_depth=depth)
    assert {one.__name__: len(one.signatures) for one in functions()} == before
    for one in functions():  # other processes compile for the types that are written beside it
        assert one.signatures == [argument_types(one)], one.__name__


def test_machine_code_of_other_versions_is_removed_once_it_is_old(tmp_path):
    new, old, recent, other = (tmp_path / name for name in ("0" * 16, "a" * 16, "b" * 16, "mine"))
    month_ago = time.time() - 31 * 86400
    for folder in (old, recent, other):
        folder.mkdir()
        (folder / "code.nbc").write_bytes(b"x")
    for folder in (old, other):
        os.utime(folder, (month_ago, month_ago))
    assert used(new) == new
    assert sorted(tmp_path.iterdir()) == [recent, other]  # only what the package itself named
    os.utime(recent, (month_ago, month_ago))
    used(recent)  # marks it
    used(new)
    assert recent.exists()
