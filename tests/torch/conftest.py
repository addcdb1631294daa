"""A small dataset on disk, whose spec the streams render again."""

from __future__ import annotations

import pytest

from eyerender.base.errors import BackendError
from tests.support.dataset_specs import make, plan

CHANGES = {"count": 20, "subjects": 4, "labels": {"noiseless": True}}


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A folder that `generate` wrote."""
    path = tmp_path_factory.mktemp("torch") / "made"
    try:
        make(path, plan(**CHANGES))
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")
    return path


@pytest.fixture
def spec():
    """The plan of `folder`."""
    return plan(**CHANGES)
