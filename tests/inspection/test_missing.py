"""Labels that images lack: those of LEDs that light one eye count among the images of this eye."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from PIL import Image

from eyerender.apps.inspection.missing import missing_labels
from eyerender.apps.inspection.pictures import measure
from eyerender.folders.imagefolder import ImageEntry


def test_leds_of_one_eye_are_not_missing_from_the_other():
    eyes = np.array(["right", "left"] * 50, dtype=object)
    x = np.where(eyes == "right", 10.0, np.nan)
    angle = np.linspace(0.0, 60.0, 100)
    lost = np.where(angle > 50.0, np.nan, x)
    columns = {"label glint 0 x (px)": x, "label glint 1 x (px)": lost, "label gaze off straight ahead (deg)": angle}
    contents: Any = SimpleNamespace(names=["a"] * 100, columns=columns, groups={"eye": eyes})
    (found,) = missing_labels(cast(Any, contents))
    assert found.labels == ["label glint 1 x (px)"]
    assert found.share == np.mean(angle[eyes == "right"] > 50.0)
    assert found.depends_on == "label gaze off straight ahead (deg)"


def test_a_further_mask_that_is_gone_is_a_fault(tmp_path):
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(12, 16)).save(tmp_path / "a.png")
    line: dict[str, Any] = {"file_name": "a.png", "annotated_mask_file_name": "as_annotated/a.png", "bit_depth": 8}
    line["window_px"] = {"x0": 0, "y0": 0, "width": 16, "height": 12}
    entry = ImageEntry(folder=tmp_path, line=line, number=1)
    (found,) = measure(entry).faults
    assert found.kind == "file"
    assert "annotated_mask" in found.detail
    (tmp_path / "as_annotated").mkdir()
    Image.new("L", (16, 12)).save(tmp_path / "as_annotated" / "a.png")
    assert measure(entry).faults == []
