"""Finding, probing and fetching libLLVM: real libraries, real processes, and a package archive made on the spot."""

from __future__ import annotations

import ctypes
import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
import time
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest

import eyerender
from eyerender.backends import set_up as set_up_module
from eyerender.backends.libraries import WHEEL, has_archive, llvm_command, load_llvm, load_runtime, runtime_store
from eyerender.backends.llvm import ENVIRONMENT, VARIANT, candidates, find_llvm, version_of
from eyerender.backends.probe import REFUSAL_AGE_S, Verdict, probe, run_probe
from eyerender.backends.set_up import fetch_library, setup_llvm
from eyerender.base.errors import BackendError
from eyerender.base.storage.cachefolder import cache_folder

COMPILER = shutil.which("cc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
needs_archive = pytest.mark.skipif(not has_archive(), reason="no apt here")


@pytest.fixture(scope="module")
def good() -> Path:
    """A libLLVM that renders."""
    found = find_llvm()[0]
    if found is None or found.path is None:
        pytest.skip("no libLLVM here can render")
    return found.path


@pytest.fixture(scope="module")
def wheel() -> Path:
    """The libLLVM of the wheel karellen-llvm-core."""
    try:
        files = distribution(WHEEL).files or []
    except PackageNotFoundError:
        pytest.skip(f"{WHEEL} is not installed here")
    return next(Path(str(f.locate())) for f in files if f.name.startswith("libLLVM.so.")).resolve()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder without verdicts; what was fetched stays in reach, a bare machine cannot load Dr.Jit without."""
    store = runtime_store()
    folder = tmp_path / "cache" / "eyerender"
    folder.mkdir(parents=True)
    if store is not None and store.is_dir():
        (folder / "lib").symlink_to(store)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder.parent))
    return folder


def python(
    code: str, unset: tuple[str, ...] = (), timeout: float = 120, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter, as a user's program would run, without the variables `unset`."""
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={name: value for name, value in os.environ.items() if name not in unset} | (environment or {}),
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


def build(folder: Path, name: str, source: str, *flags: str) -> Path:
    """Compile a shared library."""
    code = folder / f"{name}.c"
    code.write_text(source)
    assert COMPILER is not None
    subprocess.run([COMPILER, "-shared", "-fPIC", "-o", str(folder / name), str(code), *flags], check=True)
    return folder / name


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-19.so", (19,)),
        ("libLLVM-15.so.1", (15,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM.19.1.dylib", (19, 1)),
        ("libLLVM.so", ()),
        ("LLVM-C.dll", ()),
    ],
)
def test_version_is_read_from_the_name(name: str, version: tuple[int, ...]) -> None:
    assert version_of(Path("/x") / name) == version


def test_candidates_are_named_then_the_wheels_then_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = tmp_path / "named" / "libLLVM-15.so"
    own = tmp_path / "env" / "lib" / "libLLVM.so.18.1"
    loader = tmp_path / "loader"
    others = [loader / name for name in ("libLLVM.so.21.1", "libLLVM-17.so.1", "libLLVM-16.so.1", "libLLVM-14.so.1")]
    for file in (named, own, *others):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    (loader / "libLLVM-21.so").symlink_to("libLLVM.so.21.1")  # the same file must come once
    monkeypatch.setenv(ENVIRONMENT, str(named))
    install_by_hand(tmp_path / "env" / "lib" / "site-packages", "../libLLVM.so.18.1,,\n", monkeypatch)
    monkeypatch.setenv("LD_LIBRARY_PATH", str(loader))
    ours = [path for path in candidates() if tmp_path.resolve() in path.parents]
    assert ours == [path.resolve() for path in (named, own, *others)]


def install_by_hand(site: Path, record: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a distribution of the wheel's name in a folder that comes first on the path."""
    information = site / f"{WHEEL.replace('-', '_')}-1.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {WHEEL}\nVersion: 1\n")
    (information / "RECORD").write_text(record)
    monkeypatch.syspath_prepend(str(site))


def test_wheel_that_lost_its_library_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`pip install --target` drops the wheel's libraries and records them where they are not."""
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    monkeypatch.setattr(sys, "platform", "linux")
    install_by_hand(tmp_path, "../libLLVM.so.23.1,,\n", monkeypatch)
    assert "--target drops" in llvm_command()
    assert f"--prefix '{tmp_path}" in llvm_command()
    (tmp_path / "lib").mkdir()  # where that command puts it
    (tmp_path / "lib" / "libLLVM.so.23.1").touch()
    assert "--target drops" not in llvm_command()
    assert tmp_path / "lib" / "libLLVM.so.23.1" in candidates()


@pytest.fixture
def unfinished(wheel: Path, tmp_path: Path) -> Path:
    """The wheel's libraries as pip unpacks them, before the links that a start of Python makes where it may write."""
    beside = wheel.parent / "x86_64-unknown-linux-gnu"
    copy = tmp_path / "lib" / beside.name
    copy.mkdir(parents=True)
    for name in ("libc++.so.1.0", "libc++abi.so.1.0", "libunwind.so.1.0"):
        shutil.copy(beside / name, copy)
    return Path(shutil.copy(wheel, tmp_path / "lib"))


@pytest.mark.packaging
def test_wheel_renders_without_its_links(unfinished: Path) -> None:
    verdict = run_probe(VARIANT, unfinished)
    assert verdict.ok, verdict.detail


@pytest.mark.packaging
def test_libraries_of_the_wheel_stay_out_of_the_way_of_others(unfinished: Path) -> None:
    """Exceptions of another C++ library, loaded afterwards, must not end in LLVM's runtime."""
    done = python(
        f"""
        import ctypes
        from pathlib import Path
        from eyerender.backends.libraries import load_llvm, load_runtime
        def visible():
            names = ("__cxa_throw", "_Unwind_RaiseException", "LLVMContextCreate")
            return [hasattr(ctypes.CDLL(None), name) for name in names]
        load_runtime()
        before = visible()
        load_llvm(Path({str(unfinished)!r}))
        print(visible() == before)
        import mitsuba as mi
        mi.set_variant("scalar_rgb")
        try:
            mi.load_dict({{"type": "nothing of this name"}})
        except RuntimeError as error:
            print("caught")
        """
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["True", "caught"]


@pytest.mark.packaging
def test_wheel_is_found_without_site_packages(wheel: Path) -> None:
    """`python -S` with PYTHONPATH processes no .pth file."""
    code = "from eyerender.backends.choose import choose_backend; print(choose_backend('llvm').library)"
    environment = {k: v for k, v in os.environ.items() if k != ENVIRONMENT}
    environment["PYTHONPATH"] = os.pathsep.join(os.path.abspath(p) for p in sys.path)
    done = subprocess.run(
        [sys.executable, "-S", "-c", code], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.strip() == str(wheel), done.stderr


def test_cache_folder_follows_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "eyerender"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # the standard says to ignore it
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "eyerender"
    monkeypatch.setenv("HOME", "/")  # accounts of services: nothing is written to the root of the disk
    assert cache_folder() is None


def test_missing_library_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"nothing\.so"):
        load_llvm(tmp_path / "nothing.so")


def test_good_library_passes_its_probe(good: Path) -> None:
    verdict = run_probe(VARIANT, good)
    assert verdict.ok
    assert verdict.detail.startswith("LLVM ")


def test_verdict_is_remembered_until_the_library_changes(good: Path, cache: Path) -> None:
    first = probe(VARIANT, good)
    (file,) = (cache / "verdicts").iterdir()
    # What the file says is believed: no process is started any more.
    stored = json.loads(file.read_text())
    stored["verdict"]["detail"] = "LLVM remembered"
    file.write_text(json.dumps(stored))
    assert first.ok
    assert probe(VARIANT, good) == Verdict(True, "LLVM remembered")
    assert probe(VARIANT, good, context="another machine").detail == first.detail
    file.write_text("{")  # a torn file counts as none
    assert probe(VARIANT, good) == first


def test_refusal_is_looked_into_again_after_a_day(cache: Path) -> None:
    """A refusal may have had a passing cause. libc loads well and is no LLVM: Dr.Jit refuses it."""
    libc = next((p for p in map(Path, _mapped_files()) if p.name.startswith("libc.so")), None)
    if libc is None:
        pytest.skip("no libc.so to pass for a libLLVM here")
    assert not probe(VARIANT, libc).ok
    (file,) = (cache / "verdicts").iterdir()
    stored = json.loads(file.read_text())
    stored["verdict"]["detail"] = "remembered"
    file.write_text(json.dumps(stored))
    assert probe(VARIANT, libc).detail == "remembered"
    old = time.time() - REFUSAL_AGE_S - 60
    os.utime(file, (old, old))
    assert probe(VARIANT, libc).detail != "remembered"


def test_library_that_does_not_load_is_refused_but_not_for_good(cache: Path, tmp_path: Path) -> None:
    broken = tmp_path / "libLLVM-19.so"
    broken.write_text("not a library")
    verdict = probe(VARIANT, broken)
    assert not verdict.ok
    assert not verdict.lasting
    assert "libLLVM-19.so" in verdict.detail
    assert not list(cache.rglob("*.json"))


@pytest.mark.packaging
def test_cache_that_cannot_be_written_is_done_without(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    assert probe(VARIANT, good).ok


def test_probe_finds_what_was_fetched_and_no_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The probing process has a home of its own but the cache folder of its user."""
    interpreter = tmp_path / "python"
    interpreter.write_text('#!/bin/sh\necho "$HOME${DRJIT_CACHE_DIR-} $XDG_CACHE_HOME" >&2\nexit 1\n')
    interpreter.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(interpreter))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("DRJIT_CACHE_DIR", str(tmp_path))
    home, cache = run_probe(VARIANT).detail.split()
    assert str(tmp_path) not in home
    assert cache == str(tmp_path / ".cache")


@needs_compiler
def test_library_that_ends_the_process_is_survived(cache: Path, tmp_path: Path) -> None:
    source = "#include <stdlib.h>\n__attribute__((constructor)) static void die(void) { abort(); }"
    verdict = probe(VARIANT, build(tmp_path, "libLLVM-16.so", source))
    assert verdict == Verdict(False, "rendering with it ends the process (SIGABRT)")


@pytest.mark.packaging
def test_bad_library_that_the_user_names_is_passed_over(good: Path, tmp_path: Path) -> None:
    """Versions that this machine has and that do not render stand for those a user may name."""
    bad = [path for path in candidates() if path != good and not probe(VARIANT, path).ok]
    named = bad[0] if bad else tmp_path / "libLLVM-15.so"
    done = python(
        """
        from eyerender.backends.llvm import ensure_llvm
        print(ensure_llvm().path)
        import mitsuba as mi, drjit as dr
        mi.set_variant("llvm_ad_mono")
        print(dr.minimum(mi.Float(1, 2), 1.5))
        """,
        environment={ENVIRONMENT: str(named)},
    )
    assert done.returncode == 0, done.stderr
    path, result = done.stdout.splitlines()
    assert path != str(named)
    assert result == "[1, 1.5]"


@pytest.mark.packaging
def test_mitsuba_imported_before_with_a_good_library_works(good: Path) -> None:
    preload = f"""
        from pathlib import Path
        from eyerender.backends.libraries import load_llvm
        load_llvm(Path({str(good)!r}))
        import mitsuba
        from eyerender.backends.choose import choose_backend
        print(choose_backend("llvm").library)
        """
    done = python(preload, environment={ENVIRONMENT: str(good)})
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).resolve() == good


@pytest.mark.parametrize("named", ["/nonexistent/libLLVM.so", None])
def test_drjit_imported_before_eyerender_works_or_one_line_says_what_to_do(named: str | None, good: Path) -> None:
    given = {} if named is None else {ENVIRONMENT: named}
    done = python(
        """
        try:
            import mitsuba, sys
        except ImportError:
            sys.exit("bare")
        from eyerender.base.errors import BackendError
        from eyerender.backends.choose import choose_backend
        try:
            print(0, choose_backend("llvm").library)
        except BackendError as error:
            print(error.exit_code, error)
        """,
        unset=(ENVIRONMENT,),
        environment=given,
    )
    if done.stderr.strip() == "bare":
        pytest.skip("drjit finds its libraries only after eyerender here")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    if done.stdout.startswith("0"):  # the system's newest libLLVM renders
        assert named is None
        return
    assert done.stdout.startswith("3 drjit was imported before eyerender and ")
    assert "`import eyerender` above the first import" in done.stdout
    fix = re.search(rf"{ENVIRONMENT}=(\S+)", done.stdout)  # any that is good: a machine may hold several
    assert fix is not None
    assert Path(fix[1]).is_file()


def test_libllvm_that_renders_is_loaded_whatever_imports_drjit(good: Path) -> None:
    """By way of a module of the package that needs drjit, before a backend is chosen; kernels stay private."""
    done = python(
        """
        import os, eyerender.rendering.hits.meshes
        from eyerender.backends.choose import choose_backend
        import drjit as dr
        print(choose_backend("llvm").library, os.environ["DRJIT_CACHE_DIR"], dr.detail.llvm_version()[0])
        """,
        unset=(ENVIRONMENT, "DRJIT_CACHE_DIR"),
    )
    assert done.returncode == 0, done.stderr
    library, kernels, version = done.stdout.split()
    assert version_of(Path(library).resolve())[:1] in ((int(version),), ())
    assert "eyerender" in kernels


@pytest.mark.slow
def test_every_public_name_leaves_the_choice_of_libllvm_open(good: Path) -> None:
    """Each name in a process of its own, with `import mitsuba` after it, then a kernel."""
    names = eyerender.__all__
    code = """
        import os, sys, eyerender as er
        from eyerender.backends.choose import choose_backend

        def check(name):
            getattr(er, name)
            import mitsuba
            choose_backend("llvm")
            import drjit as dr
            return float(dr.sum(mitsuba.Float([1, 2]) * 2)[0]) == 6

        failed = []
        for name in {names!r}:
            child = os.fork()
            if child == 0:
                try:
                    os._exit(0 if check(name) else 1)
                except BaseException as error:
                    print(name, error, file=sys.stderr)
                    os._exit(2)
            if os.waitpid(child, 0)[1]:
                failed.append(name)
        print(failed)
        """
    done = python(code.format(names=names), unset=(ENVIRONMENT,), timeout=900)
    assert done.stdout.strip() == "[]", done.stderr


def test_importing_the_room_loads_no_mitsuba() -> None:
    done = python(
        "import sys, eyerender.backends.choose, eyerender.backends.set_up\n"
        "print([name for name in ('mitsuba', 'drjit', 'cv2') if name in sys.modules])"
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_without_a_library_the_command_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eyerender.backends.llvm.candidates", lambda: iter(()))
    with pytest.raises(BackendError, match="no libLLVM here can render") as caught:
        setup_llvm()
    assert llvm_command() in str(caught.value)
    assert "\n" not in str(caught.value)


def test_refused_library_is_told_with_its_reason(cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "libLLVM-19.so"
    broken.write_text("not a library")
    monkeypatch.setattr("eyerender.backends.llvm.candidates", lambda: iter((broken,)))
    with pytest.raises(BackendError, match=r"no libLLVM here can render \(.*libLLVM-19\.so: .*(short|invalid)"):
        setup_llvm()


ABSENT = "libeyerenderabsent.so.1"


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A library that Dr.Jit needs, as far as the package knows, and that this machine lacks; returns its store."""
    runtime = {ABSENT: ("libeyerenderabsent1", "eyerenderabsent")}
    monkeypatch.setattr("eyerender.backends.libraries.RUNTIME", runtime)
    monkeypatch.setattr("eyerender.backends.set_up.RUNTIME", runtime)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "eyerender" / "lib"


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package archive on disk with one package: a real library behind a link, as Debian packs libatomic1."""
    architecture = subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True)
    folder = tmp_path / "archive"
    folder.mkdir()
    name = "libeyerenderabsent1"
    tree = tmp_path / "build" / name
    (tree / "DEBIAN").mkdir(parents=True)
    (tree / "usr" / "lib" / "triplet").mkdir(parents=True)
    build(tree / "usr" / "lib" / "triplet", f"{ABSENT}.2.0", "int answer(void) { return 7; }")
    (tree / "usr" / "lib" / "triplet" / ABSENT).symlink_to(f"{ABSENT}.2.0")
    control = f"Package: {name}\nVersion: 1.0\nArchitecture: {architecture.stdout.strip()}\n"
    control += f"Maintainer: nobody\nDescription: {name}\nDepends: libc6\n"
    (tree / "DEBIAN" / "control").write_text(control)
    deb = folder / f"{name}_1.0.deb"
    subprocess.run(["dpkg-deb", "-b", str(tree), str(deb)], check=True, capture_output=True)
    data = deb.read_bytes()
    entry = f"{control}Filename: ./{deb.name}\nSize: {len(data)}\nSHA256: {hashlib.sha256(data).hexdigest()}\n"
    (folder / "Packages.gz").write_bytes(gzip.compress(entry.encode()))
    point_apt_at(f"deb [trusted=yes] file:{folder} ./", tmp_path, monkeypatch)
    return folder


def point_apt_at(source: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings as an administrator could make them: this one source and no other."""
    (folder / "sources.list").write_text(source + "\n")
    settings = folder / "machine.conf"
    settings.write_text(f'Dir::Etc::SourceList "{folder / "sources.list"}";\nDir::Etc::SourceParts "/dev/null";\n')
    monkeypatch.setenv("APT_CONFIG", str(settings))
    monkeypatch.setattr(set_up_module, "PAUSES_S", (0.0, 0.0))


@pytest.mark.packaging
@needs_archive
@needs_compiler
def test_library_that_drjit_lacks_is_fetched_once(archive: Path, absent: Path, good: Path) -> None:
    with pytest.raises(OSError, match="package libeyerenderabsent1 on Debian"):
        load_runtime()
    said: list[str] = []
    assert setup_llvm(say=said.append).path is not None
    load_runtime()
    assert ctypes.CDLL(str(absent / ABSENT)).answer() == 7
    assert [path.name for path in absent.iterdir()] == [ABSENT]
    setup_llvm(say=said.append)
    assert len(said) == 1


@needs_archive
@needs_compiler
def test_package_that_lacks_the_library_leaves_nothing(archive: Path, tmp_path: Path) -> None:
    with pytest.raises(BackendError, match=r"libeyerenderabsent1 of this archive has no libother\.so"):
        fetch_library("libeyerenderabsent1", "libother.so", tmp_path / "store")
    assert not list((tmp_path / "store").iterdir())


@needs_archive
@needs_compiler
def test_package_that_cannot_be_fetched_is_one_line(archive: Path, absent: Path) -> None:
    (archive / "libeyerenderabsent1_1.0.deb").unlink()
    with pytest.raises(BackendError, match=r"libeyerenderabsent1 cannot be downloaded .*; try again, or ") as caught:
        setup_llvm()
    assert "package libeyerenderabsent1 on Debian" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(absent.iterdir())


@needs_archive
def test_archive_that_does_not_answer_is_one_line(
    absent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    point_apt_at(f"deb [trusted=yes] file:{tmp_path}/nowhere ./", tmp_path, monkeypatch)
    with pytest.raises(BackendError, match="libeyerenderabsent1 cannot be downloaded") as caught:
        setup_llvm()
    assert "\n" not in str(caught.value)


def test_without_an_archive_the_package_is_named(absent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BackendError, match=rf"{ABSENT} is missing \(package libeyerenderabsent1 on Debian"):
        setup_llvm()


def _mapped_files() -> list[str]:
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return []
    return sorted({line.split(None, 5)[5] for line in lines if line.count(" ") > 5 and "/" in line})
