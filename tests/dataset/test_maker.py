"""Samples of a run: the next one is drawn while one is traced, and none depends on what comes before or after it."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.dataset.maker import Maker
from tests.support.dataset_specs import plan

pytestmark = pytest.mark.render


def test_samples_of_a_run_are_those_made_alone():
    # Half of the targets lie behind the head, where no eye can look, and there is one attempt.
    ahead = {"draw": "uniform", "low": -600, "high": 600}
    made = plan(**{"scene.targets": {"world_mm": [[ahead, 0, 0], [600, 50, 0]]}, "attempts": 1})
    maker = Maker(made, 2, threads=1)
    run = list(maker.make_all(range(12)))
    assert [sample.index for sample in run] == list(range(12))
    assert [len(sample.images) for sample in run].count(0) > 2
    for sample in run:
        alone = maker.make(sample.index)
        assert alone.rejections == sample.rejections
        assert len(alone.images) == len(sample.images)
        for one, other in zip(sample.images, alone.images, strict=True):
            assert one.line == other.line
            for kind, picture in one.pictures.items():
                np.testing.assert_array_equal(picture, other.pictures[kind])
