"""The list behind `./scripts/test --fast` is what was measured."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.quick import PLACE, listed

pytestmark = pytest.mark.packaging

TESTS = """
import time
import pytest

def burn(seconds):
    start = time.process_time()
    while time.process_time() - start < seconds:
        pass

@pytest.fixture(scope="module")
def costly():
    burn(0.25)

def test_long(): burn(0.25)
def test_short(): pass
@pytest.mark.parametrize("k", range(3))
def test_long_together(k): burn(0.09)
def test_with_costly_fixture(costly): pass
@pytest.mark.fast
def test_marked(): burn(0.25)
"""
CONFTEST = """
from pathlib import Path
from tests.support.quick import Quick, Recorder, listed

LIST = Path("list.txt")

def pytest_configure(config):
    config.pluginmanager.register(Recorder(LIST, quick_s=0.2))

def pytest_collection_modifyitems(items):
    is_quick = Quick(listed(LIST))
    print("quick:", *sorted({item.name.partition("[")[0] for item in items if is_quick(item)}))
"""


def quick_by(folder: Path) -> set[str]:
    """Run the tests of a folder; returns those that its list, as it was before, takes for quick."""
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "test_some.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return set(next(line for line in done.stdout.splitlines() if line.startswith("quick:")).split()[1:])


def test_measured_tests_and_those_with_long_fixtures_are_left_out(tmp_path):
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = fast\n")
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_some.py").write_text(TESTS)
    long = {"test_long", "test_long_together", "test_with_costly_fixture"}
    assert quick_by(tmp_path) == {"test_short", "test_marked", *long}
    assert quick_by(tmp_path) == {"test_short", "test_marked"}
    names = ["costly", "test_long", "test_long_together", "test_marked"]
    assert listed(tmp_path / "list.txt") == [f"test_some.py::{name}" for name in names]


def test_the_list_names_files_that_exist():
    root = PLACE.parents[2]
    assert all((root / name.partition("::")[0]).exists() for name in listed())
