"""The extractor's compiled functions, and its fitted weights."""

from __future__ import annotations

import copy
import json
import os
import time

import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.base.jit import argument_types, functions, used
from eyerender.extraction import FAST, REFINED, extract
from eyerender.extraction.compile import compile_all, drawn_eye
from eyerender.extraction.pupil.scoring import features
from eyerender.extraction.weights import FILE, ConfidenceTable, confidence_table, design

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


@pytest.mark.parametrize("settings", [FAST, REFINED])
def test_every_row_is_a_feature(settings):
    pupil = extract(drawn_eye(), settings=settings).pupil
    table = confidence_table(settings.method)
    assert set(table.names) <= set(features(pupil.ellipse, pupil.goodness))
    # The middle of a range is one half, which exceeds the knots 0 and 1/3.
    row = design(table.limits.mean(axis=0)[None], table.limits)[0]
    np.testing.assert_allclose(row, [1.0, *np.repeat([1.0 / 2.0, 1.0 / 6.0, 0.0], len(table.names))], atol=1e-12)


def test_a_damaged_table_is_refused():
    table = json.loads(FILE.read_text())["confidence"]["fast"]
    damaged = copy.deepcopy(table)
    next(iter(damaged["features"].values())).pop()
    for wrong in (damaged, table | {"calibration": [1.0]}, table | {"constant": [1.0, float("nan")]}):
        with pytest.raises(ValueError, match="expected finite numbers of shape"):
            ConfidenceTable.of(wrong)
