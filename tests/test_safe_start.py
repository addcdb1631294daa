"""Every child process starts in `base/processes.py`, on a path of modules that a stranger's folder is not on."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import eyerender
from eyerender.base.processes import process_pool, python_command, run

PACKAGE = Path(eyerender.__file__).resolve().parent
DOOR = PACKAGE / "base" / "processes.py"
# An extractor that is a program takes the place of the worker, which was started through the door.
EXCEPTIONS = {"apps/benchmark/worker.py: os.execvp"}
TYPES = {"multiprocessing.connection", "multiprocessing.process"}
PLANTED = "threading signal pickle struct json tempfile socket weakref selectors queue copyreg warnings random types"
PLANTED += " io re enum functools collections contextlib traceback string bisect heapq hashlib logging shutil zlib"
PLANTED += " numpy subprocess multiprocessing"


def starts(path):
    """Ways in which a module could start a process."""
    place, text = path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8")
    if not re.search(r"process|\bos\.(exec|spawn|posix_spawn|system|popen|fork)", text, re.IGNORECASE):
        return  # quicker than to walk every tree
    for node in ast.walk(ast.parse(text)):
        found = []
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner, name = ast.unparse(node.func.value), node.func.attr
            is_os = owner == "os" and name.startswith(("exec", "spawn", "posix_spawn", "system", "popen", "fork"))
            if is_os or owner in ("subprocess", "multiprocessing") or name.startswith("create_subprocess"):
                found = [f"{owner}.{name}"]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            module = str(node.module)
            names = [one.name for one in node.names]
            if module.split(".")[0] in ("subprocess", "multiprocessing") and module not in TYPES:
                found = [f"{module}.{name}" for name in names]
            elif "ProcessPoolExecutor" in names:
                found = ["ProcessPoolExecutor"]
        yield from (f"{place}: {one}" for one in found)


def test_only_one_module_starts_processes():
    found = {start for path in PACKAGE.rglob("*.py") if path != DOOR for start in starts(path)}
    assert found == EXCEPTIONS
    assert len(list(starts(DOOR))) >= 5  # the search does find


def test_only_one_module_names_the_interpreter_to_run():
    found = []
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text if "sys.executable" in text else "")
        lists = [node for node in ast.walk(tree) if isinstance(node, ast.List | ast.Tuple)]
        if path != DOOR and any(
            "sys.executable" in map(ast.unparse, node.elts) and "'-m'" in map(ast.unparse, node.elts) for node in lists
        ):
            found.append(path.name)
    assert found == []


def test_settings_of_libraries_in_the_current_folder_are_not_read(tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("mine", encoding="utf-8")
    folder = tmp_path / "theirs"
    folder.mkdir()
    # numba would empty the file, and import any module; matplotlib would wait for the pipe.
    (folder / ".numba_config.yaml").write_text(f"chrome_trace: {precious}\ndisable_jit: 1\n", encoding="utf-8")
    os.mkfifo(folder / "matplotlibrc")
    script = (
        "import os\n"
        "from eyerender.base.jit import config\n"
        "from eyerender.report.style import figure\n"
        "with figure(1, 1): print(config.DISABLE_JIT, os.getcwd())\n"
        "from numba.core.config import reload_config; reload_config(); print(config.DISABLE_JIT)\n"
    )
    argv = [sys.executable, "-P", "-c", script]
    env = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run(argv, cwd=folder, capture_output=True, text=True, timeout=60, check=True, env=env)
    assert done.stdout.split() == ["0", str(folder), "0"]
    assert precious.read_text(encoding="utf-8") == "mine"


@pytest.fixture
def theirs(tmp_path):
    """A folder with modules of standard names, which leave a mark when they run."""
    mark = tmp_path / "mark"
    folder = tmp_path / "theirs"
    folder.mkdir()
    for name in PLANTED.split():
        (folder / f"{name}.py").write_text(f"open({str(mark)!r}, 'a').write('{name} ')\n", encoding="utf-8")
    return folder, mark


def test_planted_modules_do_not_run(theirs):
    folder, mark = theirs
    script = (
        "import sys; from eyerender.base.processes import process_pool, ordered\n"
        "with process_pool(2) as pool: print(sum(pool.map(abs, [-1, -2])))\n"
        "print(sum(ordered(abs, [-1, -2], 2)))\n"
    )
    root = str(PACKAGE.parent)
    command = [sys.executable, "-P", "-c", script]
    done = subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": root}, capture_output=True, text=True)
    assert done.stdout == "3\n3\n", done.stderr
    assert not mark.exists(), mark.read_text()


def test_planted_modules_run_without_the_safe_path(theirs):
    folder, mark = theirs
    subprocess.run([sys.executable, "-c", "import threading"], cwd=folder, capture_output=True)
    assert mark.exists()


def test_a_module_is_run_on_a_safe_path(theirs, monkeypatch):
    folder, mark = theirs
    monkeypatch.setenv("PYTHONPATH", str(PACKAGE.parent))
    run(python_command("eyerender.apps.benchmark.worker", "--check", "json:loads"), cwd=folder, capture_output=True)
    assert not mark.exists(), mark.read_text()


def test_a_pool_leaves_the_environment(monkeypatch):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    before = dict(os.environ)
    with process_pool(1) as pool:
        assert pool.submit(os.getenv, "PYTHONSAFEPATH").result() == "1"
    assert dict(os.environ) == before
