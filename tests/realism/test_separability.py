"""The two-sample test on drawn pictures: equal samples cannot be told apart, and different textures can."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.apps.realism.figures import Scaled
from eyerender.apps.realism.folder import FolderFigures
from eyerender.apps.realism.patches import KINDS, patches
from tests.realism import drawn

_IMAGES = 14


def _folder(first: int, sigma: float) -> FolderFigures:
    """A folder of pictures with noise of a scale (px of the picture) on them, of which the irises are compared."""
    rows = []
    for seed in range(first, first + _IMAGES):
        grain = drawn.noise_of_band((drawn.HIGH, drawn.WIDE), sigma, 2 * sigma, seed)
        shown = patches(Scaled.of(drawn.picture(drawn.levels() * (1 + 0.12 * grain), labelled=False)), seed)
        rows.append({kind: shown[kind] if kind == "iris" else () for kind in KINDS})
    return FolderFigures(
        path=str(first), images=_IMAGES, gamma=1.0, gamma_from="given", landmarks="masks", rows=(), skipped=(),
        tiles=(), patches=tuple(rows),
    )  # fmt: skip


def test_patches_have_equal_scale_and_exposure():
    levels = drawn.levels()
    bright, dark = (patches(Scaled.of(drawn.picture(levels * k)), 1) for k in (1.0, 0.3))
    assert list(bright) == list(KINDS)
    assert {p.shape for p in bright["iris"]} == {(20, 20)}
    for kind in KINDS:
        for a, b in zip(bright[kind], dark[kind], strict=True):
            assert np.abs(a.astype(int) - b).max() <= 3  # rounding before and after the compression


@pytest.mark.packaging
def test_only_different_folders_are_told_apart():
    pytest.importorskip("sklearn")
    from eyerender.apps.realism.separability import separability

    one, same, other = _folder(0, 8.0), _folder(100, 8.0), _folder(200, 3.5)
    alike, apart = separability(one, same)["iris"], separability(one, other)["iris"]
    assert alike.images == (_IMAGES, _IMAGES)
    assert alike.interval[0] < 0.5 + 0.1  # of fourteen and fourteen images, the area has a standard deviation of .11
    assert alike.auc < 0.8
    assert apart.auc > 0.95
    assert all(len(shown) == 8 for shown in apart.revealing)
    assert separability(one, other)["sclera"] is None


@pytest.mark.packaging
def test_a_folder_is_told_from_a_camera_that_was_left_out_only_where_it_differs_from_all():
    pytest.importorskip("sklearn")
    from eyerender.apps.realism.separability import left_out

    cameras = [_folder(100 * k, 4.0 + k) for k in range(1, 4)]
    like_them, unlike = (left_out(_folder(900, sigma), cameras)["iris"] for sigma in (6.5, 1.5))
    assert unlike.auc > 0.95
    assert unlike.interval[0] > like_them.interval[0]
    assert like_them.auc < 0.85
    assert like_them.cameras == 3
    assert like_them.placebo == unlike.placebo  # it does not depend on the folder
    assert like_them.placebo_interval[0] <= like_them.placebo <= like_them.placebo_interval[1]
    assert left_out(_folder(900, 6.5), cameras[:2])["iris"] is None
