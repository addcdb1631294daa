"""Every example runs by itself and draws a picture; at small size, as its comments `# small:` say."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from eyerender.eye.spec import EyeSpec
from tests.support.paths import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
QUICK = ("01",)
SMALL = re.compile(r"^(\w+(?:, \w+)*) = .*  # small: (.*)$", re.M)
SAVED = """
import matplotlib.pyplot as plt
for number in plt.get_fignums():
    plt.figure(number).savefig(f"picture_{number}.png", dpi=50)
"""


def small(source: str) -> str:
    """An example at the size that its comments give for trying it."""
    return SMALL.sub(r"\1 = \2", source)


@pytest.mark.render
@pytest.mark.parametrize(
    "path", [pytest.param(p, id=p.stem, marks=() if p.name[:2] in QUICK else pytest.mark.slow) for p in EXAMPLES]
)
def test_the_example_runs_and_draws(path, tmp_path):
    script = tmp_path / path.name
    script.write_text(small(path.read_text(encoding="utf-8")) + SAVED, encoding="utf-8")
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, script.name], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    pictures = sorted(tmp_path.glob("picture_*.png"))
    assert pictures
    for picture in pictures:
        assert np.asarray(Image.open(picture).convert("L")).std() > 5


def test_examples_are_numbered_and_explain_themselves():
    numbers = [int(p.name[:2]) for p in EXAMPLES]
    assert numbers == list(range(1, len(numbers) + 1))
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        title, rule, *rest = text.split("\n")[1:]
        assert len(title) == len(rule), path.name
        assert set(rule) == {"="}
        assert len(text.splitlines()) < 80
        assert any(rest)


def test_the_schematic_eye_of_pye3d_has_its_measures():
    """A stop 10.392 mm before the centre of the globe, and a cornea of 7.8 mm; both spheres end at the limbus."""
    eye = EyeSpec.from_mapping(runpy.run_path(str(ROOT / "examples" / "pye3d.py"))["SCHEMATIC"]).build()
    centre = eye.rotation.azimuth_centre_mm
    assert eye.stop.centre_mm[0] - centre[0] == pytest.approx(10.392, abs=1e-3)
    assert eye.front_indices == (1.3375,)
    limbus = np.array([eye.stop.centre_mm[0], eye.limbus_radius_mm])
    assert np.linalg.norm(limbus - [centre[0], 0.0]) == pytest.approx(eye.sclera.radius_mm)
    assert np.linalg.norm(limbus - [-7.8, 0.0]) == pytest.approx(7.8)
