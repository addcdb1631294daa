"""The choice of a backend, and the messages where none renders."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from eyerender.backends.choose import VARIANTS, Backend, BackendState, choose_backend
from eyerender.backends.doctor import backend_states, doctor_report
from eyerender.backends.llvm import ENVIRONMENT, find_llvm
from eyerender.base.errors import BackendError, InputError

needs_llvm = pytest.mark.skipif(find_llvm()[0] is None, reason="no libLLVM here can render")


@pytest.fixture(scope="module")
def cuda() -> BackendState:
    """What the GPU backend says of this machine."""
    return next(state for state in backend_states() if state.name == "cuda")


@needs_llvm
def test_llvm_sets_the_variant_and_tells_its_versions() -> None:
    backend = choose_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    assert mi.variant() == backend.variant == "llvm_ad_mono"
    assert backend.versions == {
        "mitsuba": version("mitsuba"),
        "drjit": version("drjit"),
        "llvm": ".".join(map(str, dr.detail.llvm_version())),
    }
    assert backend.library is not None
    assert os.path.realpath(os.environ["DRJIT_LIBLLVM_PATH"]) == os.path.realpath(backend.library)
    assert hash(backend) == hash(choose_backend("llvm"))


@needs_llvm
@pytest.mark.parametrize("threads", [1, 2])
def test_threads_are_those_asked_for(threads: int) -> None:
    import drjit as dr

    before = choose_backend("llvm").threads
    try:
        assert choose_backend("llvm", threads=threads).threads == threads == dr.thread_count()
    finally:
        dr.set_thread_count(before)


@needs_llvm
def test_another_variant_that_the_user_set_is_replaced() -> None:
    choose_backend("llvm")
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    choose_backend("llvm")
    assert mi.variant() == "llvm_ad_mono"


def test_auto_takes_the_gpu_only_where_it_renders(cuda: BackendState) -> None:
    if not cuda.ok and find_llvm()[0] is None:
        with pytest.raises(BackendError):
            choose_backend()
    else:
        assert choose_backend().name == ("cuda" if cuda.ok else "llvm")


def test_gpu_that_is_not_there_is_an_error_with_a_fix(cuda: BackendState) -> None:
    if cuda.ok:
        pytest.skip("a GPU renders here")
    with pytest.raises(BackendError, match="--backend llvm") as caught:
        choose_backend("cuda")
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)


def test_broken_driver_is_found_out_without_harm(tmp_path: Path) -> None:
    """A library that is no driver, where the driver is looked for: refused by the probe, told by the state."""
    libm = next((name for name in ("libm.so.6", "libSystem.dylib") if _loads(name)), None)
    if libm is None:
        pytest.skip("no library to pass for a driver here")
    code = "from eyerender.backends.doctor import backend_states; print(backend_states()[0].ok)"
    environment = {**os.environ, "DRJIT_LIBCUDA_PATH": libm, "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "False", done.stderr


@pytest.mark.parametrize(("arguments", "path"), [({"name": "metal"}, "backend"), ({"threads": 0}, "threads")])
def test_wrong_arguments_are_input_errors(arguments: dict[str, object], path: str) -> None:
    with pytest.raises(InputError) as caught:
        choose_backend(**arguments)  # type: ignore[arg-type]
    assert caught.value.path == path


def test_state_without_a_library_names_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eyerender.backends.llvm.candidates", lambda: iter(()))
    llvm = backend_states()[1]
    assert llvm.name == "llvm"
    assert not llvm.ok
    assert llvm.detail == "no libLLVM on this machine"
    assert llvm.fix


def test_process_without_a_library_ends_with_one_line_and_no_abort(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom eyerender.backends import llvm\nllvm.candidates = lambda: iter(())\n"
        "from eyerender.base.errors import BackendError\nfrom eyerender.backends.choose import choose_backend\n"
        "try:\n    choose_backend('llvm')\nexcept BackendError as error:\n    sys.exit(f'{error.exit_code}: {error}')\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != ENVIRONMENT}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        pytest.skip("the libLLVM that Dr.Jit finds by itself renders here")
    assert done.returncode == 1
    assert done.stderr.startswith("3: no libLLVM here can render")
    assert done.stderr.count("\n") == 1


def test_doctor_reports_both_backends_and_is_plain_data() -> None:
    report = doctor_report()
    assert [state.name for state in report.backends] == ["cuda", "llvm"]
    assert report.ok == any(state.ok for state in report.backends)
    assert (report.chosen is None) != report.ok
    assert all(state.ok or state.fix for state in report.backends)
    assert dict(report.packages)["mitsuba"] != "unknown"
    plain = dataclasses.asdict(report)
    assert plain["backends"][1]["name"] == "llvm"


def test_backend_cannot_be_changed() -> None:
    backend = Backend(name="llvm", variant=VARIANTS["llvm"], device="cpu", threads=1, mitsuba="3.9.1", drjit="1.5.0")
    with pytest.raises(dataclasses.FrozenInstanceError):
        backend.threads = 2  # type: ignore[misc]


def _loads(name: str) -> bool:
    import ctypes

    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True
