"""The extractor's compiled functions against NumPy versions of them, on what extraction calls them with."""

from __future__ import annotations

import os
import time

import numpy as np

import make_ideal_images as ideal
from eyerender.base.jit import argument_types, functions, used
from eyerender.extraction import extract
from eyerender.extraction.compile import compile_all
from eyerender.extraction.glints import detection, gaussian_model, prescreening, subtraction
from eyerender.extraction.pupil import (
    candidates,
    consensus,
    covariance,
    edge_model,
    edges,
    least_squares,
    occlusion,
    outline,
    places,
    refinement,
)
from tests.support import extraction_oracles as oracles

CONDITIONS = ("eight-glints", "lid", "jpeg")
COMPARED = [
    (candidates, "_ring_levels"),
    (candidates, "_levels_about"),
    (candidates, "_interior"),
    (edges, "_ridges"),
    (edges, "_at_the_iris"),
    (consensus, "direct_fits"),
    (consensus, "_support"),
    (consensus, "_settled"),
    (covariance, "_edge_sums"),
    (outline, "_along"),
    (edge_model, "_levels"),
    (least_squares, "_pixel_sums"),
    (refinement, "_band"),
    (places, "sectors_at"),
    (occlusion, "boundary_terms"),
    (occlusion, "levels_and_slopes"),
    (detection, "_maxima"),
    (detection, "_widths"),
    (detection, "_parted"),
    (detection, "_above_ring"),
    (prescreening, "_gaussian_like"),
    (gaussian_model, "_spot_rows"),
    (subtraction, "_subtracted"),
]


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
    single = ("_settled", "_ring_levels", "_ridges", "_above_ring")  # single precision in one of the two
    # Of an ellipse through nearly straight points only some six digits are determined.
    limit = 1e-4 if name in single else 1e-5 if name == "direct_fits" else 1e-8
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=limit * scale, err_msg=name)


def test_compiled_functions_give_what_numpy_gives(monkeypatch):
    compile_all()  # before names are replaced, by which compiled functions know each other
    called = {name: 0 for _, name in COMPARED}

    def compared(function, name):
        def both(*args):
            called[name] += 1
            result = function(*args)
            same(result, getattr(oracles, name)(*args), name)
            return result

        return both

    for module, name in COMPARED:
        monkeypatch.setattr(module, name, compared(getattr(module, name), name))
    for image, depth in images():
        assert extract(image, bit_depth=depth).pupil.ok
    assert min(called.values()) > 0, called


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
