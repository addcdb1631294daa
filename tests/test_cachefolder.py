"""Cache folders: nobody else can have put anything into one that is used."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from eyerender.base.storage import cachefolder
from eyerender.base.storage.cachefolder import cache_folder, private_folder

OTHER = 65534  # nobody
as_root = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")


@pytest.fixture(autouse=True)
def _unwarned(monkeypatch):
    monkeypatch.setenv(cachefolder._WARNED, "")


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_new_folder_and_its_parents_are_private_whatever_the_umask(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a" / "cache"))
    before = os.umask(0)
    try:
        found = cache_folder()
    finally:
        os.umask(before)
    assert found == tmp_path / "a" / "cache" / "eyerender"
    assert [mode(place) for place in (found, found.parent, found.parents[1])] == [0o700] * 3


def test_a_folder_that_others_can_read_becomes_private(tmp_path, capfd):
    place = tmp_path / "cache"
    place.mkdir(0o755)
    assert private_folder(place) == place
    assert mode(place) == 0o700
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("where", ["itself", "parent"])
def test_a_folder_that_others_can_write_is_refused_with_one_warning(tmp_path, capfd, where):
    place = tmp_path / "parent" / "cache"
    place.mkdir(parents=True)
    (place if where == "itself" else place.parent).chmod(0o777)
    assert private_folder(place) is None
    assert private_folder(place) is None
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"warning: the cache folder {place} is not used, because other users can write to ")
    assert mode(place) != 0o700  # it is left as it was
    # Processes that this one starts know of the warning.
    module = "eyerender.base.storage.cachefolder"
    code = f"from pathlib import Path; from {module} import private_folder as f; print(f(Path('{place}')))"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (child.stdout.strip(), child.stderr) == ("None", "")


def test_a_sticky_parent_may_be_open_but_the_folder_itself_may_not(tmp_path):
    shared = tmp_path / "tmp"
    shared.mkdir()
    shared.chmod(0o1777)
    assert private_folder(shared / "cache") == shared / "cache"
    assert private_folder(shared) is None


@as_root
@pytest.mark.parametrize("group", [0, OTHER])
def test_a_writable_group_counts_only_if_others_are_in_it(tmp_path, group):
    place = tmp_path / "cache"
    place.mkdir()
    os.chown(place, 0, group)
    place.chmod(0o770)
    assert (private_folder(place) is not None) == (group == 0)
    assert mode(place) == (0o700 if group == 0 else 0o770)


@as_root
@pytest.mark.parametrize("planted", ["folder", "parent", "link", "link to ours", "dangling link", "file"])
def test_what_another_user_planted_is_refused(tmp_path, capfd, planted):
    shared, own = tmp_path / "tmp", tmp_path / "own"
    own.mkdir(0o755)
    shared.mkdir()
    shared.chmod(0o1777)
    place = shared / "cache"
    if planted in ("folder", "parent"):
        place.mkdir(0o755)
    elif planted == "file":
        place.touch()
    else:
        place.symlink_to({"link": shared, "link to ours": own, "dangling link": own / "new"}[planted])
    os.chown(place, OTHER, OTHER, follow_symlinks=False)
    wanted = place / "eyerender" if planted == "parent" else place
    assert private_folder(wanted) is None
    assert f"because {place} belongs to another user" in capfd.readouterr().err
    assert mode(own) == 0o755  # nothing was changed through a planted link
    assert not list(own.iterdir())
    assert planted in ("file", "link", "link to ours", "dangling link") or not list(place.iterdir())


@as_root
def test_a_link_of_ours_may_not_lead_through_anothers(tmp_path):
    real, theirs, ours = tmp_path / "real", tmp_path / "theirs", tmp_path / "ours"
    real.mkdir()
    theirs.symlink_to(real)
    ours.symlink_to(theirs)
    assert private_folder(ours / "x") == ours / "x"
    os.chown(theirs, OTHER, OTHER, follow_symlinks=False)
    assert private_folder(ours / "x") is None


def test_links_in_a_circle_are_refused(tmp_path):
    (tmp_path / "a").symlink_to("../" + tmp_path.name + "/b")
    (tmp_path / "b").symlink_to("a")
    assert private_folder(tmp_path / "a") is None


@as_root
def test_a_folder_of_root_that_others_only_read_is_good_for_a_user(tmp_path):
    place = Path("/usr/share")  # readable for everybody, of root
    code = (
        "import os; from pathlib import Path; from eyerender.base.storage.cachefolder import private_folder\n"
        f"os.setuid({OTHER}); print(private_folder(Path({str(place)!r})))"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == str(place)


def test_a_place_that_cannot_be_made_is_done_without_in_silence(tmp_path, capfd):
    (tmp_path / "file").touch()
    assert private_folder(tmp_path / "file" / "cache") is None
    assert capfd.readouterr().err == ""


@as_root
def test_a_planted_cache_is_not_used_by_any_of_its_users(tmp_path):
    """Maps, verdicts of probes, fetched libraries, numba's index, Dr.Jit's kernels, an interpreter: none is touched."""
    cache = tmp_path / "cache" / "eyerender"
    python = cache / "pupil-detectors" / "bin" / "python"
    library = cache / "lib" / "libatomic.so.1"
    for file in (python, library):
        file.parent.mkdir(parents=True)
        file.write_text("#!/bin/sh\n")
        file.chmod(0o755)
    os.chown(cache, OTHER, OTHER)
    code = (
        "import os, sys\n"
        "from eyerender.backends.libraries import runtime_store\n"
        "from eyerender.apps.benchmark.shipped import pupil_labs_python\n"
        "from eyerender.backends.choose import _keep_kernels_private\n"
        "from eyerender.region import mapcache\n"
        "_keep_kernels_private(); kernels = os.environ['DRJIT_CACHE_DIR']\n"
        "assert os.stat(kernels).st_mode & 0o777 == 0o700\n"
        "from eyerender.base import jit\n"
        "print([runtime_store(), pupil_labs_python(), mapcache.folder(), jit.FOLDER])\n"
        "function = jit.compiled()(lambda x: x + 1); assert function(1) == 2; print(function.stats.cache_path)\n"
        "print(kernels)"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment.pop("DRJIT_CACHE_DIR", None)
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert child.returncode == 0, child.stderr
    places, kept, kernels = child.stdout.splitlines()
    assert places == "[None, None, None, None]"
    assert kept == "None"
    assert not kernels.startswith(str(tmp_path))
    assert not Path(kernels).exists()  # temporary
    assert child.stderr.count("\n") == 1  # one warning for all of them


def test_kernels_of_drjit_are_kept_in_the_private_folder(tmp_path):
    from eyerender.backends.libraries import runtime_store
    from eyerender.backends.llvm import find_llvm

    if find_llvm()[0] is None:
        pytest.skip("no libLLVM renders here")
    fetched = runtime_store()
    if fetched is not None and fetched.is_dir():  # on a bare system, only there is what Dr.Jit is linked with
        shutil.copytree(fetched, tmp_path / "eyerender" / "lib")
    code = (
        "from eyerender.backends.choose import choose_backend; choose_backend('llvm', 1)\n"
        "import drjit as dr, mitsuba as mi; dr.eval(dr.arange(mi.Float, 64) * 1.5)"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "HOME": str(tmp_path / "home")}
    environment |= {"DRJIT_LIBLLVM_PATH": str(find_llvm()[0].path)}
    environment.pop("DRJIT_CACHE_DIR", None)
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
    assert list((tmp_path / "eyerender" / "drjit").glob("*.bin"))
    assert not (tmp_path / "home" / ".drjit").exists()


@as_root
def test_a_folder_that_the_user_names_for_kernels_is_checked_too(tmp_path):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    os.chown(theirs, OTHER, OTHER)
    code = (
        "import os; from eyerender.backends.choose import _keep_kernels_private\n"
        "_keep_kernels_private(); print(os.environ['DRJIT_CACHE_DIR'])"
    )
    environment = {**os.environ, "DRJIT_CACHE_DIR": str(theirs)}
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert child.stdout.strip() != str(theirs)
    assert child.stderr.count("\n") == 1
