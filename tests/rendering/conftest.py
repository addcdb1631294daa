"""A renderer for the session."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from eyerender.backends.choose import choose_backend
from eyerender.base.errors import BackendError

if TYPE_CHECKING:
    from eyerender.rendering.renderer import Renderer


@pytest.fixture(scope="session")
def backend() -> Any:
    try:
        return choose_backend("llvm", threads=1)
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")


@pytest.fixture(scope="session")
def renderer(backend: Any) -> Renderer:
    from eyerender.rendering.renderer import Renderer

    return Renderer(backend, spp=16)


@pytest.fixture(autouse=True)
def _recordings(request):
    """Tests that replace code have no recordings of the code before, and leave none."""
    if "monkeypatch" not in request.fixturenames or "renderer" not in request.fixturenames:
        yield
        return
    from eyerender.rendering.records.recording import forget

    forget()
    yield
    forget()
