"""The compiled functions against their NumPy twins, on what extraction calls them with."""

from __future__ import annotations

import importlib.util
import os
import time

import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.extraction import compiled, extract
from eyerender.extraction.compiled import TWINS, kernel

CONDITIONS = ("eight-glints", "lid", "jpeg")


@pytest.fixture
def without(monkeypatch):
    """Extraction without compiled functions."""
    monkeypatch.setenv("EYERENDER_COMPILED", "0")
    kernel.cache_clear()
    yield
    kernel.cache_clear()


def images():
    for condition in CONDITIONS:
        drawing = ideal.draw(condition, 3)
        yield drawing.image, drawing.parameters["bit_depth"]


def same(ours, theirs, name):
    """Compare results; an ellipse from OpenCV's single precision differs by some 1e-5 px."""
    if isinstance(ours, tuple):
        assert len(ours) == len(theirs), name
        for one, other in zip(ours, theirs, strict=True):
            same(one, other, name)
        return
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert ours.shape == theirs.shape, name
    if ours.dtype.kind in "bi":
        assert (ours == theirs).mean() > 0.999, name
        return
    scale = float(np.nanmax(np.abs(theirs), initial=1e-3))
    single = ("settled", "ring_levels", "ridges")  # single precision in one of the two
    # Of an ellipse through nearly straight points only some six digits are determined.
    limit = 1e-4 if name in single else 1e-5 if name == "direct_fits" else 1e-8
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=limit * scale, err_msg=name)


@pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="needs the extra `fast`")
def test_every_compiled_function_gives_what_its_twin_gives(monkeypatch):
    called = dict.fromkeys(TWINS, 0)

    def compared(name):
        function = kernel(name)

        def both(*args):
            called[name] += 1
            result = function(*args)
            same(result, TWINS[name](*args), name)
            return result

        return both

    monkeypatch.setattr(compiled, "kernel", compared)
    for image, depth in images():
        assert extract(image, bit_depth=depth).pupil.ok
    assert min(called.values()) > 0, called


def test_extraction_is_the_same_with_and_without(without, monkeypatch):
    results = [extract(image, bit_depth=depth).pupil for image, depth in images()]
    monkeypatch.setenv("EYERENDER_COMPILED", "1")
    kernel.cache_clear()
    for (image, depth), pupil in zip(images(), results, strict=True):
        other = extract(image, bit_depth=depth).pupil
        np.testing.assert_allclose(other.ellipse.centre_px, pupil.ellipse.centre_px, atol=1e-4)
        np.testing.assert_allclose(other.ellipse.semi_axes_px, pupil.ellipse.semi_axes_px, atol=1e-4)
        assert other.confidence == pytest.approx(pupil.confidence, abs=1e-4)


@pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="needs the extra `fast`")
def test_machine_code_of_other_versions_is_removed_once_it_is_old(tmp_path):
    from eyerender.jit import used

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
