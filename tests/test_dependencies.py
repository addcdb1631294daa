"""What the package imports is what it declares."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

import eyerender

pytestmark = pytest.mark.packaging

PACKAGE = Path(eyerender.__file__).resolve().parent
PROJECT = PACKAGE.parent / "pyproject.toml"
# Distributions whose module has another name.
MODULES = {
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "scikit-image": "skimage",
    "scikit-learn": "sklearn",
}
# Holds shared libraries and no module; backends/libraries.py loads them.
LIBRARIES = {"karellen_llvm_core"}
# Runs in an environment of its own, as an extractor to compare with; see scripts/tools/setup_pupil_detectors.sh.
ELSEWHERE = {"pupil_detectors"}


def imported() -> set[str]:
    """Top-level modules that the package imports, lazily or through import_module, without the standard library."""
    names: set[str] = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names.add(node.module)
            elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
                names |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    own = {name.split(".")[0] for name in names if not name.startswith(".")}
    return own - set(sys.stdlib_module_names) - {"eyerender"} - ELSEWHERE


def modules_of(requirements: list[str]) -> set[str]:
    """Their modules' names."""
    names = [re.split(r"[<>=!~ \[;]", r)[0].lower() for r in requirements]
    return {MODULES.get(name, name.replace("-", "_")) for name in names}


@pytest.mark.skipif(not PROJECT.is_file(), reason="not a checkout")
def test_what_is_imported_is_declared_and_the_other_way_about():
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    needed = modules_of(project["dependencies"])
    extras = modules_of(
        [
            r
            for name, some in project["optional-dependencies"].items()
            if name not in ("test", "oracles", "fuzz", "docs")
            for r in some
        ]
    )
    assert imported() - extras == needed - LIBRARIES
    assert extras <= imported()
