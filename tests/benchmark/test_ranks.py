"""The comparison of the ranks of two benches."""

from __future__ import annotations

import json

import numpy as np
import pytest

import compare_ranks


def results(path, shares, images=40):
    """A bench whose detectors have an IoU of 0.95 on a share of the images, and none on the others."""
    entries = []
    for name, share in shares.items():
        hit = np.arange(images) < share * images
        answers = [
            {"image": f"{k}", "outcome": "right" if h else "none", "iou": 0.95 if h else None}
            for k, h in enumerate(hit)
        ]
        answers.append({"image": "closed", "outcome": "absent", "iou": None})
        entries.append({"name": name, "answers": answers})
    path.write_text(json.dumps({"schema": "eyerender/bench-extractors/3", "extractors": entries, "image_digests": {}}))
    return path


@pytest.mark.parametrize(
    ("second", "tau"),
    [
        pytest.param((0.2, 0.4, 0.9), 1.0, marks=pytest.mark.slow),
        pytest.param((0.9, 0.4, 0.2), -1.0, marks=pytest.mark.slow),
        ((0.2, 0.9, 0.4), 1 / 3),
    ],
)
def test_tau_of_shares(tmp_path, monkeypatch, capsys, second, tau):
    names = ("a", "b", "c")
    paths = [
        results(tmp_path / "first.json", {**dict(zip(names, (0.1, 0.5, 0.8), strict=True)), "own-fast": 1.0}),
        results(tmp_path / "second.json", {**dict(zip(names, second, strict=True)), "own-fast": 0.0}),
    ]
    monkeypatch.setattr("sys.argv", ["compare_ranks.py", *map(str, paths), "--json"])
    compare_ranks.main()
    found = json.loads(capsys.readouterr().out)
    assert found["detectors"] == list(names)
    assert found["images"] == [40, 40]
    for row in found["thresholds"]:
        assert row["tau"] == pytest.approx(tau)
        assert row["interval"][0] <= row["tau"] <= row["interval"][1]
        assert row["shares"][1] == pytest.approx(second)
