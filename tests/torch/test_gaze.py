"""The small network for gaze, its calibration, and the networks of the study of appearance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")

from eyerender.apps.study import appearance_networks as networks  # noqa: E402
from eyerender.torch.gaze import GRID, calibrated, gaze_errors, nine, turned  # noqa: E402
from tests.support.dataset_specs import make_or_skip, plan  # noqa: E402


@pytest.fixture
def directions():
    """Twenty-five directions (n, 3) within 20 degrees of one, as a camera sees them, and their angles (n, 2)."""
    degrees = np.stack(np.meshgrid(np.linspace(-20, 20, 5), np.linspace(-15, 15, 5)), axis=-1).reshape(-1, 2)
    return Rotation.from_euler("yx", degrees, degrees=True).apply([0.1, 0.2, -0.97]), degrees


def test_nine_points_take_away_what_is_wrong_with_one_eye(directions):
    """A constant turn of the eye is nearly an offset of angles; without one, nothing changes."""
    true, degrees = directions[0] / np.linalg.norm(directions[0], axis=1, keepdims=True), directions[1]
    rows = nine(degrees)
    np.testing.assert_array_equal(degrees[rows], GRID[np.argsort(np.argsort(GRID[:, 1], kind="stable"))])
    np.testing.assert_allclose(calibrated(true, true, rows), true, atol=1e-12)
    off = Rotation.from_euler("yx", [4, 2], degrees=True).apply(true)
    data = {"camera_gaze": torch.tensor(true), "gaze_deg": torch.tensor(degrees),
            "subject": torch.zeros(25, dtype=int), "left": torch.zeros(25, dtype=bool)}  # fmt: skip
    before, after = gaze_errors({"camera_gaze": off}, data)
    assert np.isnan(before[rows]).all()
    assert np.nanmean(before) > 3
    assert np.nanmax(after) < 0.35
    rest = np.setdiff1d(np.arange(25), rows)
    np.testing.assert_allclose(np.degrees(np.arccos((off * true).sum(axis=1)))[rest], before[rest], atol=1e-6)


def test_vectors_are_turned_as_a_camera_that_faces_the_pupil_would_see_them():
    rng = np.random.default_rng(1)
    rays = torch.nn.functional.normalize(torch.tensor(rng.normal(size=(20, 3)) * [0.5, 0.5, 0] + [0, 0, 1]), dim=-1)
    vectors = torch.tensor(rng.normal(size=(20, 3)))
    torch.testing.assert_close(turned(rays, rays), torch.tensor([[0.0, 0, 1]]).double().expand(20, 3))
    torch.testing.assert_close(turned(turned(vectors, rays), rays, back=True), vectors)


def test_networks_of_the_study_repeat_to_the_bit_and_know_whom_they_test(tmp_path, monkeypatch):
    two = plan(count=28, subjects=2, splits={"train": 0.5, "test": 0.5})
    folder = make_or_skip(tmp_path / "made", two)
    monkeypatch.setattr(networks, "COPIES", 6)
    threads = torch.get_num_threads()
    folders = {"people": folder, "E1": folder}
    one, other = (networks.errors_of_networks(folders, 2, "people") for _ in range(2))
    assert torch.get_num_threads() == threads
    assert not torch.are_deterministic_algorithms_enabled()
    assert one.trained_on == "people"
    assert (one.people, one.pictures) == (1, 14)
    for name, errors in one.error_deg.items():
        assert errors.shape == (2, 2, 1)
        np.testing.assert_array_equal(errors, other.error_deg[name])
    np.testing.assert_array_equal(one.error_deg["people"], one.error_deg["E1"])  # the same pictures
    before = one.error_deg["people"][0]
    assert np.isfinite(before).all()
    assert (before[0] != before[1]).all()  # the seeds differ
