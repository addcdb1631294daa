"""Masks as people draw them: lids cut the eye, lashes do not."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.region.anatomy import Brow, Lashes, Region
from eyerender.scene.parts import FRAME
from tests.support import render_rigs as rigs

pytestmark = pytest.mark.render


def labels(renderer, **changes):
    rig = rigs.head_rig()
    job = rigs.job_of(rigs.eye_of("E2"), rig, rig.window(320, 240), annotated=True, **changes)
    return renderer.render(job, spp=1).labels


@pytest.mark.parametrize("blink", [0.6])
def test_it_is_the_mask_of_a_lid_without_lashes(renderer, blink):
    """The same lids rendered without any hair; two rays along silhouettes may differ by the step past a hair."""
    region = Region(seed=5, blink=blink, lashes=Lashes(upper_length_mm=12.0))
    hairless = {"lashes": Lashes(upper_count=0, lower_count=0), "brow": Brow(count=0)}
    hairy, bare = (labels(renderer, region=r) for r in (region, region.model_copy(update=hairless)))
    assert np.array_equal(bare.annotated, bare.part)
    assert np.count_nonzero(hairy.annotated != bare.part) <= 2
    seen = hairy.part > 0
    assert np.array_equal(hairy.annotated[seen], hairy.part[seen])
    assert np.count_nonzero(hairy.annotated) > np.count_nonzero(seen) + 50
    behind = hairy.behind(np.arange(240)[:, None] + np.zeros((240, 320)) < 40)
    assert np.all(behind.annotated[:40] == FRAME)
    assert np.array_equal(behind.annotated[40:], hairy.annotated[40:])


def test_without_lids_it_is_the_mask(renderer):
    bare = labels(renderer)
    assert np.array_equal(bare.annotated, bare.part)
