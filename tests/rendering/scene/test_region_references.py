"""Skin, lids and lashes against stored pictures, pixel by pixel; tests/support/region_references.py gives the level."""

from __future__ import annotations

import pytest

from tests.support.region_references import ALLOWED, SCENES, STORED, TEST_SEEDS, refused_share, rendered, stored

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def references():
    return stored()


@pytest.mark.parametrize("name", SCENES)
def test_the_picture_is_that_of_the_version(renderer, references, name):
    share = refused_share(rendered(renderer, name, TEST_SEEDS), references[name])
    assert share <= ALLOWED, (
        f"{100 * share:.2g} % of the pixels have changed. If that is intended, raise RESULTS in imagefolder.py and "
        "run: python -m tests.support.region_references"
    )


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        pytest.param("open", {"skin": {"albedo": 0.55 * 1.02}}, marks=pytest.mark.slow),  # 2 %
        ("open", {"fissure": {"upper_mm": 3.8}}),  # 0.1 mm
        pytest.param("shut", {"skin": {"albedo": 0.55 * 1.02}}, marks=pytest.mark.slow),
        pytest.param("near", {"fissure": {"lower_mm": 5.3}}, marks=pytest.mark.slow),
    ],
    ids=["albedo-open", "upper-open", "albedo-shut", "lower-near"],
)
def test_small_changes_are_seen(renderer, references, name, changed):
    # 48 %, 34 %, 90 % and 8 % of the pixels had changed.
    assert refused_share(rendered(renderer, name, TEST_SEEDS, changed), references[name]) > 10 * ALLOWED


def test_the_references_stay_small():
    assert STORED.stat().st_size < 200_000
