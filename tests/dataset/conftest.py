"""One small dataset for the session, made by one worker."""

from __future__ import annotations

import pytest

from eyerender.base.errors import BackendError
from tests.support.dataset_specs import make, plan


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """The folder of the tiny spec."""
    folder = tmp_path_factory.mktemp("dataset") / "tiny"
    try:
        make(folder, plan())
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")
    return folder
