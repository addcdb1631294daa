"""The container's recipe and its lock; `scripts/prove-bare --container` runs the recipe."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from _dockerfile import build_script, instructions, run_script
from lock_requirements import LEFT_OUT
from tests.support.paths import ROOT

DOCKERFILE = ROOT / "containers" / "Dockerfile"

pytestmark = [pytest.mark.skipif(not DOCKERFILE.is_file(), reason="not a checkout"), pytest.mark.packaging]


def locked() -> dict[str, str]:
    """Version by name."""
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+) ", (ROOT / "requirements.lock").read_text(), re.MULTILINE))


def test_lock_agrees_with_constraints() -> None:
    pins = re.findall(r"^(\S+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    pinned: dict[str, str] = {canonicalize_name(name): version for name, version in pins}
    lock = locked()
    assert len(lock) > 50
    assert {name: pinned.get(name) for name in lock} == lock


def test_lock_holds_hashes_and_no_address() -> None:
    text = (ROOT / "requirements.lock").read_text()
    assert "//" not in text
    entries = re.sub(r" \\\n *", " ", text).splitlines()
    entries = [entry for entry in entries if not entry.startswith("#")]
    assert len(entries) == len(locked())
    assert all(re.fullmatch(r"\S+==\S+( --hash=sha256:[0-9a-f]{64})+", entry) for entry in entries)


def test_lock_holds_what_the_package_its_extras_and_its_build_need() -> None:
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = pyproject["project"]["optional-dependencies"]
    needed = [*pyproject["project"]["dependencies"], *pyproject["build-system"]["requires"]]
    needed += [line for name in extras.keys() - LEFT_OUT for line in extras[name]]
    lock = locked()
    for requirement in map(Requirement, needed):
        assert requirement.specifier.contains(lock[canonicalize_name(requirement.name)])


def test_recipe_installs_by_the_lock_and_keeps_caches_private() -> None:
    found = list(instructions(DOCKERFILE.read_text()))
    runs = [rest for word, rest in found if word == "RUN"]
    assert any("pip install" in run and "--require-hashes -r requirements.lock" in run for run in runs)
    assert all("--require-hashes" in run or "--no-deps" in run for run in runs if "pip install" in run)
    # Apptainer binds the host's /tmp, which everybody may write to.
    assert "/tmp" not in " ".join(rest for word, rest in found if word == "ENV")


def test_steps_of_a_recipe_become_scripts(tmp_path: Path) -> None:
    (tmp_path / "context").mkdir()
    (tmp_path / "context" / "b").write_text("taken")
    recipe = f"""
    # a comment
    FROM nothing:1
    WORKDIR {tmp_path}/work
    COPY b folder/
    RUN cd folder \\
        && test -f b
    RUN test -f folder/b
    ENV WORD=hello
    ENTRYPOINT ["sh", "-c", "echo $WORD $0 $PWD"]
    CMD ["default word"]
    """
    (tmp_path / "work" / "folder").mkdir(parents=True)
    subprocess.run(["sh", "-c", build_script(recipe, f"{tmp_path}/context")], check=True)
    for arguments, word in (([], "default word"), (["given"], "given")):
        command = ["sh", "-c", run_script(recipe), "sh", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stdout == f"hello {word} {tmp_path}/work\n"


def test_failing_step_ends_the_build_and_an_unknown_one_is_refused(tmp_path: Path) -> None:
    script = build_script(f"FROM x\nRUN false\nRUN touch {tmp_path}/after\n", "/nowhere")
    assert subprocess.run(["sh", "-c", script], check=False).returncode != 0
    assert not list(tmp_path.iterdir())
    with pytest.raises(SystemExit, match="ADD is not translated"):
        build_script("FROM x\nADD a b\n", "/nowhere")
