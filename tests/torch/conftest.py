"""A small dataset on disk, whose spec the streams render again."""

from __future__ import annotations

import pytest

from tests.support.dataset_specs import make_or_skip, plan

CHANGES = {"count": 20, "subjects": 4, "labels": {"noiseless": True}}


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A folder that `generate` wrote."""
    return make_or_skip(tmp_path_factory.mktemp("torch") / "made", plan(**CHANGES))


@pytest.fixture
def spec():
    """The plan of `folder`."""
    return plan(**CHANGES)
