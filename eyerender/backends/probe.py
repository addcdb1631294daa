"""Test whether a backend renders, in a separate process, because a wrong libLLVM ends the process that uses it.

`python -m eyerender.backends.probe VARIANT [LIBRARY]` is that process. `run_probe` starts it, `probe` also caches the
result.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import math
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..base.errors import WRONG, EyerenderError, InputError
from ..base.processes import python_command, run
from ..base.storage.cachefolder import cache_folder
from ..base.storage.files import read_json, write_json
from ..base.versions import package_version
from .hook import HOOK
from .libraries import load_llvm, load_runtime

TIMEOUT_S = 180.0
REFUSAL_AGE_S = 86400.0  # a failure is tested again after a day, because the GPU may have been busy or memory short
_MARK = "eyerender-probe: "
_VERDICT_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome of a probe."""

    ok: bool  # whether the backend renders
    detail: str  # the reason why not, or what was found (LLVM's version, the GPU's name)
    # False for a reason that may disappear without a change of the library: a missing dependency, a time-out
    lasting: bool = True


def cpu_name() -> str:
    """Return the name of the processor as its maker writes it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def probe(variant: str, library: Path | None = None, *, context: str = "", refresh: bool = False) -> Verdict:
    """Run `run_probe`, with its result cached on disk for this library, interpreter, processor and versions.

    Args:
        variant: Mitsuba's variant, "llvm_ad_mono" or "cuda_ad_mono".
        library: the libLLVM to use; None leaves the choice to Dr.Jit.
        context: anything else on which the verdict depends (the GPU's driver).
        refresh: probe even if a verdict is cached.
    """
    key: dict[str, Any] = {
        "variant": variant,
        "library": _identity(library),
        "context": context,
        "versions": [package_version("mitsuba"), package_version("drjit"), sys.version, sys.executable],
        "machine": [platform.machine(), cpu_name()],
    }
    folder = cache_folder()
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:32]
    file = folder / "verdicts" / f"{digest}.json" if folder else None
    if file is not None and not refresh:
        known = _read_verdict(file)
        if known is not None:
            return known
    verdict = run_probe(variant, library)
    if file is not None and verdict.lasting:
        with contextlib.suppress(OSError, EyerenderError):  # a cache that cannot be written is done without
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, {"key": key, "verdict": asdict(verdict)}, sync=False)
    return verdict


def run_probe(variant: str, library: Path | None = None, timeout_s: float = TIMEOUT_S) -> Verdict:
    """Render a small image with `variant` in a new process and check the result."""
    with tempfile.TemporaryDirectory(prefix="eyerender-probe-") as home:
        environment = dict(os.environ)
        # The process has its own kernel cache, because Dr.Jit would use a kernel that another libLLVM compiled. Fetched
        # libraries stay in the user's cache folder.
        environment["HOME"] = environment["DRJIT_CACHE_DIR"] = home
        cache = cache_folder()
        if cache is not None:
            environment["XDG_CACHE_HOME"] = str(cache.parent)
        environment["PYTHONPATH"] = os.pathsep.join(os.path.abspath(p) for p in sys.path)
        if library is not None:
            environment["DRJIT_LIBLLVM_PATH"] = str(library)
        command = python_command("eyerender.backends.probe", variant)
        command += [str(library)] if library is not None else []
        try:
            done = run(
                command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout_s, check=False
            )
        except subprocess.TimeoutExpired:
            return Verdict(False, f"no answer within {timeout_s:.0f} s", lasting=False)
        except OSError as error:
            return Verdict(False, f"cannot start {sys.executable or 'Python'}: {error.strerror}", lasting=False)
    return _judge(done.returncode, done.stdout.decode(errors="replace"), done.stderr.decode(errors="replace"))


def _judge(status: int, out: str, err: str) -> Verdict:
    for line in out.splitlines():
        if line.startswith(_MARK):
            answer = json.loads(line.removeprefix(_MARK))
            if not answer["ok"] and (refusal := re.search(r"LLVM version \((\d+)\) is too old", err)):
                return Verdict(False, f"LLVM {refusal[1]} is too old for Dr.Jit")
            if status == 0 or not answer["ok"]:
                return Verdict(answer["ok"], answer["detail"], answer["lasting"])
    if status < 0:
        name = signal.Signals(-status).name if -status in set(signal.Signals) else f"signal {-status}"
        # A kill comes from outside (memory, a person) and says nothing about the library.
        return Verdict(False, f"rendering with it ends the process ({name})", lasting=name != "SIGKILL")
    return Verdict(False, (err.strip().splitlines() or [f"exit status {status}"])[-1], lasting=False)


def _identity(library: Path | None) -> Sequence[Any]:
    if library is None:
        return [os.environ.get("DRJIT_LIBLLVM_PATH", ""), os.environ.get("LD_LIBRARY_PATH", "")]
    try:
        status = library.stat()
    except OSError:
        return [str(library)]
    return [str(library), status.st_size, status.st_mtime_ns]


def _read_verdict(file: Path) -> Verdict | None:
    try:
        stored = read_json(file, limit=_VERDICT_BYTES, follow=False)["verdict"]
        verdict = Verdict(bool(stored["ok"]), str(stored["detail"]))
        return verdict if verdict.ok or time.time() - file.stat().st_mtime < REFUSAL_AGE_S else None
    except (InputError, OSError, *WRONG):
        return None


def _work(variant: str) -> str:
    """Test arithmetic on which wrong versions crash, then a ray-traced image; return the detail."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    if variant.startswith("llvm"):
        dr.set_thread_count(2)
    # No kernel with this literal was compiled before, so it is compiled here and now.
    offset = float(time.time_ns() % 65521) / 64
    x = dr.arange(mi.Float, 64) + offset
    y = dr.minimum(x, offset + 31.5) - offset
    total = dr.sum(dr.if_stmt((x, y), y > 8, lambda x, y: dr.maximum(y, 0) ** 2, lambda x, y: y * y))[0]
    expected = sum(min(i, 31.5) ** 2 for i in range(64))
    if not math.isclose(total, expected, rel_tol=1e-3):
        raise ArithmeticError(f"wrong arithmetic: {total} instead of {expected}")

    # A unit sphere seen and lit from distance 5: on the axis the radiance is albedo / pi * I / d^2 = 0.5 / pi.
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": {
                "type": "perspective",
                "fov": 1,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "luminance"},
            },
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            "light": {"type": "point", "position": [0, 0, 5], "intensity": 16.0},
        }
    )
    radiance = dr.mean(mi.render(scene, spp=4).array)[0]
    if not math.isclose(radiance, 0.5 / math.pi, rel_tol=0.02):
        raise ArithmeticError(f"wrong picture: {radiance} instead of {0.5 / math.pi}")
    if variant.startswith("llvm"):
        return "LLVM " + ".".join(map(str, dr.detail.llvm_version()))
    return _gpu_name()


def _gpu_name() -> str:
    """Return the name of the first GPU, from the driver that the process has just used."""
    driver = ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1")
    device, name = ctypes.c_int(), ctypes.create_string_buffer(128)
    if driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), 0) or driver.cuDeviceGetName(name, 128, device):
        return "GPU"
    return name.value.decode(errors="replace")


def main(arguments: Sequence[str]) -> int:
    """Run the probing process: print one line of JSON; exit with 0 if the variant renders."""
    lasting = True
    try:
        if sys.platform != "win32":
            import resource

            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        library = Path(arguments[1]) if len(arguments) > 1 else None
        lasting = False  # a library that does not load may lack something that is installed later
        HOOK.prepare = None  # this process keeps what it tests; preparing would start such processes without end
        load_runtime()
        if library:
            load_llvm(library)
            os.environ["DRJIT_LIBLLVM_PATH"] = str(library)
        lasting = True
        answer = {"ok": True, "detail": _work(arguments[0]), "lasting": True}
    except Exception as error:
        answer = {"ok": False, "detail": _line(error), "lasting": lasting}
    print(_MARK + json.dumps(answer), flush=True)
    return 0 if answer["ok"] else 1


def _line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
