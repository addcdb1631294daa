"""Labels that images lack: those of LEDs that light one eye count among the images of this eye."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from eyerender.apps.inspection.missing import missing_labels


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
