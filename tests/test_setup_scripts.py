"""The set-up scripts: the stamp, the failures that must leave none, and the pinned versions."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest

from tests.support.paths import ROOT

SCRIPTS = (
    "scripts/_setup.sh",
    "scripts/eyerender",
    "scripts/test",
    "scripts/docs",
    "scripts/test-dependencies",
    "scripts/test-torch",
    "scripts/test-live",
    "scripts/prove-bare",
    ".ci/run",
)

pytestmark = [
    pytest.mark.skipif(not (ROOT / "scripts" / "_setup.sh").is_file(), reason="not a checkout"),
    pytest.mark.packaging,
]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The scripts and the files they hash, in a folder of their own whose name holds a space."""
    folder = tmp_path / "a checkout"
    shutil.copytree(ROOT / "scripts", folder / "scripts")
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, folder)
    # Waiting between attempts is shortened for the test, the attempts are not.
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "sleep").write_text("#!/bin/sh\n")
    (tmp_path / "bin" / "sleep").chmod(0o755)
    return folder


def run(checkout: Path, command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a shell command line in the checkout, with this interpreter as the one to build with."""
    path = f"{checkout.parent / 'bin'}:/usr/local/bin:/usr/bin:/bin"
    return subprocess.run(
        ["sh", "-c", command],
        cwd=checkout,
        env={"PATH": path, "HOME": str(checkout.parent), "EYERENDER_PYTHON": sys.executable, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def fingerprint(checkout: Path) -> str:
    """What the stamp of a finished set-up of this checkout would hold."""
    (checkout / "scripts" / "ask").write_text('. "$(dirname "$0")/_setup.sh"\nfingerprint\n')
    answer = run(checkout, "sh scripts/ask")
    assert answer.stdout, answer.stderr
    return answer.stdout


def stamped(checkout: Path) -> None:
    """A finished set-up, as far as the scripts can tell; its `eyerender` repeats its arguments."""
    (checkout / ".venv" / "bin").mkdir(parents=True)
    (checkout / ".venv" / "bin" / "python").symlink_to(Path(sys.executable).resolve())
    program = checkout / ".venv" / "bin" / "eyerender"
    program.write_text('#!/bin/sh\nprintf "%s|" "$@"\nexit 7\n')
    program.chmod(0o755)
    (checkout / ".venv" / ".stamp-run").write_text(fingerprint(checkout))


def test_stamped_environment_is_used_as_it_is(checkout: Path) -> None:
    stamped(checkout)
    done = run(checkout, "cd / && \"$OLDPWD/scripts/eyerender\" --flag 'two words'")
    assert (done.returncode, done.stdout, done.stderr) == (7, "--flag|two words|", "")


def test_script_may_be_called_through_a_link(checkout: Path) -> None:
    stamped(checkout)
    (checkout.parent / "bin" / "ey").symlink_to(checkout / "scripts" / "eyerender")
    assert run(checkout, "ey --version").stdout == "--version|"


@pytest.mark.parametrize("change", ["pyproject.toml", "constraints.txt", "interpreter", "place"])
def test_stamp_changes_with_all_it_depends_on(checkout: Path, change: str) -> None:
    stamped(checkout)
    before = fingerprint(checkout)
    assert fingerprint(checkout) == before
    if change == "interpreter":
        python = checkout / ".venv" / "bin" / "python"
        python.unlink()
        python.symlink_to("/bin/sh")
    elif change == "place":
        checkout = checkout.rename(checkout.parent / "moved")
    else:
        (checkout / change).write_text((checkout / change).read_text() + "\n# changed\n")
    assert fingerprint(checkout) != before


def test_failed_setup_leaves_no_stamp_and_says_one_line(checkout: Path) -> None:
    done = run(checkout, "./scripts/eyerender --version", PIP_NO_INDEX="1", PIP_CONFIG_FILE="/dev/null")
    assert done.returncode == 1
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert sum("trying again" in line for line in lines) == 2
    assert sum("error" in line for line in lines) == 1
    assert "index does not answer" in lines[-1]
    assert not list((checkout / ".venv").glob(".stamp*"))


def test_help_of_a_command_with_an_extra_installs_nothing(checkout: Path) -> None:
    stamped(checkout)
    done = run(checkout, "./scripts/eyerender live --help")
    assert (done.stdout, done.stderr) == ("live|--help|", "")


def test_an_extra_is_added_to_what_is_installed(checkout: Path) -> None:
    stamped(checkout)
    python = checkout.parent / "bin" / "python3"
    python.write_text(
        f'#!/bin/sh\n[ "$1 $2" != "-m pip" ] || {{ echo "$@" >>asked; exit; }}\nexec {sys.executable} "$@"\n'
    )
    python.chmod(0o755)
    done = run(checkout, "./scripts/eyerender live SCENE", EYERENDER_PYTHON=str(python))
    assert done.stdout == "live|SCENE|", done.stderr
    asked = (checkout / "asked").read_text()
    assert "extras.txt" in asked
    assert " -e " not in asked
    assert (checkout / ".venv" / "extras.txt").read_text().startswith("nicegui")
    assert all((checkout / ".venv" / f".stamp-{part}").read_text() == fingerprint(checkout) for part in ("run", "live"))


def test_an_extra_that_cannot_be_added_leaves_no_stamp_of_its_own(checkout: Path) -> None:
    stamped(checkout)
    done = run(checkout, "./scripts/eyerender live SCENE", PIP_NO_INDEX="1", PIP_CONFIG_FILE="/dev/null")
    assert (done.returncode, done.stdout) == (1, "")
    assert [path.name for path in (checkout / ".venv").glob(".stamp*")] == [".stamp-run"]


def test_python_that_is_too_old_is_told(checkout: Path) -> None:
    old = checkout.parent / "bin" / "python3"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    for name in ("python", "python3.11", "python3.12", "python3.13", "python3.14"):
        (checkout.parent / "bin" / name).symlink_to(old)
    done = run(checkout, "./scripts/test", EYERENDER_PYTHON="")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "Python 3.11 or newer" in done.stderr
    assert not (checkout / ".venv").exists()


def test_dependencies_are_oldest_or_newest(checkout: Path) -> None:
    done = run(checkout, "./scripts/test-dependencies latest")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "eyerender: error: usage: scripts/test-dependencies oldest|newest|INTERPRETER [PYTEST ARGS]\n"
    assert not list(checkout.glob(".venv*"))


def test_oldest_dependencies_are_the_lower_bounds(checkout: Path) -> None:
    """The set-up ends for want of an index, after it has written what it wants."""
    done = run(checkout, "./scripts/test-dependencies oldest", PIP_NO_INDEX="1", PIP_CONFIG_FILE="/dev/null")
    assert done.returncode == 1
    wanted = (checkout / ".venv-oldest" / "constraints.txt").read_text().splitlines()
    project = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *extras["ray"], *extras["ellseg"], *extras["parquet"]]
    names = [re.split("[<>=]", line)[0] for line in needed]
    assert [line.partition("==")[0] for line in wanted] == names
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9a-z.]*", line) for line in wanted)
    assert not (checkout / ".venv").exists()


def test_two_setups_at_once_take_turns(checkout: Path) -> None:
    """The lock is held by a stand-in for a set-up; the second waits for it and then finds the stamp it left."""
    stamped(checkout)
    stamp = checkout / ".venv" / ".stamp-run"
    good = stamp.read_text()
    stamp.unlink()
    holder = "import fcntl, sys, time; fcntl.flock(9, fcntl.LOCK_EX); print(flush=True); sys.stdin.readline()"
    with subprocess.Popen(
        ["sh", "-c", f"exec 9>>.venv.lock; exec '{sys.executable}' -c '{holder}'"],
        cwd=checkout,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as first:
        assert first.stdin is not None
        assert first.stdout is not None
        first.stdout.readline()
        second = subprocess.Popen(
            ["./scripts/eyerender", "--version"],
            cwd=checkout,
            env={"PATH": "/usr/bin:/bin", "EYERENDER_PYTHON": sys.executable},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert second.stderr is not None
        assert "waiting" in second.stderr.readline()
        stamp.write_text(good)
        first.stdin.write("\n")
        first.stdin.flush()
        out, err = second.communicate(timeout=60)
    assert (second.returncode, out, err) == (7, "--version|", "")


@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_parse(script: str) -> None:
    shell = "bash" if "bash" in (ROOT / script).read_text().partition("\n")[0] else "sh"
    subprocess.run([shell, "-n", str(ROOT / script)], check=True)


def test_every_dependency_is_pinned_and_none_has_an_address() -> None:
    text = (ROOT / "constraints.txt").read_text()
    pins = dict(re.findall(r"^([A-Za-z0-9._-]+)==(\S+)$", text, re.MULTILINE))
    assert "://" not in text
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==\S+|#.*|", line) for line in text.splitlines())
    pinned = {_normal(name) for name in pins}
    assert {"mitsuba", "hatchling", "editables"} <= pinned
    assert sorted(_closure("eyerender", {"test"}) - pinned - {"eyerender"}) == []


def _closure(name: str, extras: set[str]) -> set[str]:
    """The distributions that a distribution needs here, and those that they need."""
    from packaging.requirements import Requirement

    found: set[str] = set()
    todo = [(name, extras)]
    while todo:
        current, wanted = todo.pop()
        found.add(_normal(current))
        try:
            needs = requires(current) or []
        except PackageNotFoundError:
            continue
        for need in map(Requirement, needs):
            applies = need.marker is None or any(need.marker.evaluate({"extra": e}) for e in (wanted or {""}) | {""})
            if applies and _normal(need.name) not in found:
                todo.append((need.name, need.extras))
    return found


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_each_user_of_a_checkout_gets_the_library_once(checkout):
    """The package looks for the library in its user's cache, so that of another user is none."""
    stamped(checkout)
    python = checkout / ".venv" / "bin" / "python"
    python.unlink()  # a link to this interpreter
    python.write_text('#!/bin/sh\necho "$HOME" >>asked\nprintf "%s\\n" "$PWD/asked"\n')
    python.chmod(0o755)
    (checkout / "scripts" / "ask").write_text('. "$(dirname "$0")/_setup.sh"\nset_up_llvm\n')
    for home in ("/a", "/a", "/b", "/b", "/a"):
        assert run(checkout, "sh scripts/ask", HOME=home).returncode == 0
    assert (checkout / "asked").read_text().split() == ["/a", "/b", "/a"]
