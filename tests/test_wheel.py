"""The wheel works without the checkout: scenes and templates travel inside it."""

from __future__ import annotations

import email
import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import eyerender
from tests.support.paths import ROOT

pytestmark = pytest.mark.packaging


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the wheel installed in it, the wheel, and the archive of sources that the wheel was built from."""
    if not (ROOT / "pyproject.toml").is_file():
        pytest.skip("no checkout to build from")
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]  # sources, then wheel
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = out.glob("*.whl")
    (sources,) = out.glob("*.tar.gz")
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
    return out / "site", wheel, sources


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
    folder, _, _ = site
    where = run(folder, tmp_path, "-c", "import eyerender; print(eyerender.__file__, len(dir(eyerender)))")
    file, names = where.stdout.split()
    assert Path(file).is_relative_to(folder)
    assert int(names) == len(eyerender.__all__)
    done = run(folder, tmp_path, "-m", "eyerender", "features", "guestrin2006", "--json", "-")
    assert done.returncode == 0, done.stderr
    data = json.loads(done.stdout)
    assert data["schema"] == "eyerender/features/1"
    assert len(data["records"]) == 5 * 9 * 2
    assert len(data["rig"]["lights_mm"]) == 2
    assert list(tmp_path.iterdir()) == []


def test_wheel_holds_what_the_package_reads_and_nothing_of_the_checkout(site):
    _, wheel, _ = site
    names = set(zipfile.ZipFile(wheel).namelist())
    scenes = {p.name for p in (ROOT / "scenes").glob("*.yaml")}
    assert {f"eyerender/data/scenes/{name}" for name in scenes} <= names
    assert "eyerender/py.typed" in names
    assert "eyerender/report/templates/page.html.j2" in names
    assert not [n for n in names if n.startswith(("tests/", "scripts/", "docs/"))]


def package_files():
    """The tracked files of the package, relative to the checkout."""
    listed = subprocess.run(["git", "ls-files", "eyerender"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("no git to list the files of the package")
    return set(listed.stdout.splitlines())


def test_sources_and_wheel_hold_every_file_of_the_package(site):
    _, wheel, sources = site
    with tarfile.open(sources) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert package_files() <= inside
    assert {"README.md", "LICENSE", "CHANGELOG.md", "SECURITY.md", "CITATION.cff", "constraints.txt"} <= inside
    assert {"docs/index.md", "examples/01_first_image.py", "scripts/test", "tests/conftest.py"} <= inside
    assert package_files() <= set(zipfile.ZipFile(wheel).namelist())


def test_metadata_says_what_the_index_shows(site):
    _, wheel, _ = site
    archive = zipfile.ZipFile(wheel)
    (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
    data = email.message_from_bytes(archive.read(name))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (data["Name"], data["Version"]) == ("eyerender", project["version"])
    assert (data["License-Expression"], data["Requires-Python"]) == ("MIT", ">=3.11")
    assert data["Description-Content-Type"] == "text/markdown"
    declared = {c.rpartition(" ")[2] for c in data.get_all("Classifier") if re.fullmatch(r".*Python :: 3\.\d+", c)}
    assert declared == {"3.11", "3.12", "3.13"}


def test_version_is_the_same_everywhere_and_its_changes_are_listed():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    releases = re.findall(r"^## (\S+) - (\d{4}-\d{2}-\d{2})$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert releases
    assert releases[0][0] == version


@pytest.mark.render
def test_the_notebook_runs_from_the_wheel(site, tmp_path):
    """Its cells in their order, as one script; the lines for a hosted notebook are comments."""
    folder, _, _ = site
    notebook = json.loads((ROOT / "examples" / "first_notebook.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    script = tmp_path / "notebook.py"
    script.write_text("import matplotlib\n\nmatplotlib.use('Agg')\n" + "\n\n".join(cells), encoding="utf-8")
    done = run(folder, tmp_path, str(script))
    assert done.returncode == 0, done.stderr
    assert float(re.search(r"mean gaze error: ([\d.]+) deg", done.stdout)[1]) < 1.0
