"""Small labelled folders of both kinds: drawn, and rendered."""

from __future__ import annotations

import pytest

import make_ideal_images as ideal
from eyerender.base.errors import BackendError
from eyerender.imaging.folder import render_folder
from eyerender.scene import Scene, shipped_scenes
from eyerender.scene.spec import SceneSpec


@pytest.fixture(scope="session")
def drawn(tmp_path_factory):
    """Six ideal images of 200 x 160 px with noise between 1 and 4 DN."""
    conditions = ideal.CONDITIONS
    conditions["small"] = ideal.Condition(size=(200, 160), semi_axis=(14, 20), noise=(1, 4))
    try:
        folder = tmp_path_factory.mktemp("bench") / "drawn"
        ideal.write(folder, "small", 6, 10_000)
    finally:
        del conditions["small"]
    return folder


@pytest.fixture(scope="session")
def rendered(tmp_path_factory):
    """Four rendered windows before a remote camera with two lights."""
    spec = SceneSpec.load(shipped_scenes()["quickstart"])
    data = spec.to_mapping()
    data["targets"] = {"world_mm": [[800, 150, 0], [800, -200, -100]]}
    data["rig"]["lights"] = [
        {"position_mm": [560, side * 120.0, -250], "radius_mm": 2.5, "intensity_mw_sr": 100} for side in (1, -1)
    ]
    data["image"] = {**data["image"], "window_px": [200, 160], "spp": 8}
    folder = tmp_path_factory.mktemp("bench") / "rendered"
    try:
        render_folder(Scene.of(SceneSpec.from_mapping(data, source="test"), source="test"), folder, backend="llvm")
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")
    return folder


@pytest.fixture
def no_report(monkeypatch):
    """A bench whose report is not drawn, which takes longer than the bench itself."""
    monkeypatch.setattr("eyerender.apps.benchmark.run.write_bench_report", lambda *_: None)
