"""The wheel works without the checkout: scenes and templates travel inside it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the wheel installed in it."""
    if not (ROOT / "pyproject.toml").is_file():
        pytest.skip("no checkout to build from")
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = out.glob("*.whl")
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--target",
        str(out / "site"),
    ]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    return out / "site", wheel


def run(site, cwd, *argv):
    return subprocess.run(
        [sys.executable, "-P", *argv],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_features_of_a_shipped_scene_from_another_folder(site, tmp_path):
    folder, _ = site
    where = run(folder, tmp_path, "-c", "import eyerender; print(eyerender.__file__)")
    assert Path(where.stdout.strip()).is_relative_to(folder)
    done = run(folder, tmp_path, "-m", "eyerender", "features", "guestrin2006", "--json", "-")
    assert done.returncode == 0, done.stderr
    data = json.loads(done.stdout)
    assert data["schema"] == "eyerender/features/1"
    assert len(data["records"]) == 5 * 9 * 2
    assert len(data["rig"]["lights_mm"]) == 2
    assert list(tmp_path.iterdir()) == []


def test_wheel_holds_what_the_package_reads_and_nothing_of_the_checkout(site):
    _, wheel = site
    names = set(zipfile.ZipFile(wheel).namelist())
    scenes = {p.name for p in (ROOT / "scenes").glob("*.yaml")}
    assert {f"eyerender/data/scenes/{name}" for name in scenes} <= names
    assert "eyerender/py.typed" in names
    assert "eyerender/report/templates/comparison.html.j2" in names
    assert not [n for n in names if n.startswith(("tests/", "scripts/", "docs/"))]
