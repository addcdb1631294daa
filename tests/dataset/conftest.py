"""One small dataset for the session, made by one worker."""

from __future__ import annotations

import pytest

from tests.support.dataset_specs import make_or_skip, plan


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """The folder of the tiny spec."""
    return make_or_skip(tmp_path_factory.mktemp("dataset") / "tiny", plan())
