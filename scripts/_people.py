"""Measure one recipe of people in the checkout that PYTHONPATH names: `_people.py JOB`, a JSON line on stdout.

JOB is JSON: recipe (a file), divisor of the resolution, spp (or null), images, warm (images made before), backend. All
images are of the first subject, so that its maps are made before the measurement begins.
"""

from __future__ import annotations

import cProfile
import json
import os
import pstats
import resource
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import yaml  # noqa: E402

from eyerender.dataset.maker import Maker  # noqa: E402
from eyerender.dataset.plan import Plan  # noqa: E402
from eyerender.dataset.realise import frames_of  # noqa: E402
from eyerender.dataset.shard import write_shard  # noqa: E402
from eyerender.dataset.spec import DatasetSpec  # noqa: E402

_TOP = 12


def recipe(file: Path, divisor: int, spp: int | None, images: int, subjects: int = 1) -> dict[str, Any]:
    """The mapping of a recipe with fewer pixels, which see the same, and with so many images of each subject."""
    data = yaml.safe_load(file.read_text(encoding="utf-8"))
    _shrink(data["scene"], divisor)
    data = {key: value for key, value in data.items() if key not in ("planned", "choice")}
    data |= {"count": images * subjects, "subjects": subjects, "shard_size": images}
    if spp is not None:
        data["scene"]["image"]["spp"] = spp
    return dict(data)


def _shrink(node: Any, divisor: int) -> None:
    """Divide resolutions, windows and focal lengths, and multiply the pitch of pixels, in place."""
    if isinstance(node, dict):
        for key in ("resolution_px", "window_px"):
            if key in node:
                node[key] = [size // divisor for size in node[key]]
        if "focal_length_px" in node:
            node["focal_length_px"] /= divisor
        if "pixel_pitch_um" in node:
            node["pixel_pitch_um"] *= divisor
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        _shrink(child, divisor)


def measure(job: dict[str, Any]) -> dict[str, Any]:
    """CPU seconds per image of all threads, seconds by the clock, MiB, and the profile's top rows of one more image."""
    warm, images = job["warm"], job["images"]
    data = recipe(Path(job["recipe"]), job["divisor"], job["spp"], warm + images + 1)
    plan = Plan.of(DatasetSpec.from_mapping(data))
    maker = Maker(plan, frames_of(plan), backend=job["backend"], threads=1)
    for k in range(warm):
        maker.make(k)
    clock, start = time.perf_counter(), time.process_time()
    for _ in maker.make_all(range(warm, warm + images)):
        pass
    cpu, wall = (time.process_time() - start) / images, (time.perf_counter() - clock) / images
    profile = cProfile.Profile()
    profile.enable()
    maker.make(warm + images)
    profile.disable()
    with tempfile.TemporaryDirectory() as folder:
        write_shard(maker, Path(folder), 0, lambda *_: None)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"cpu_s": cpu, "wall_s": wall, "memory_mib": memory, "profile": _top(profile)}


def _top(profile: cProfile.Profile) -> list[list[Any]]:
    """Rows (share of the time, function) of the functions that take the most time themselves."""
    stats: Any = pstats.Stats(profile)
    whole = max(stats.total_tt, 1e-9)
    rows = sorted(((row[2] / whole, name) for name, row in stats.stats.items()), reverse=True)[:_TOP]
    return [[round(share, 4), f"{Path(file).name}:{function}"] for share, (file, _, function) in rows]


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[1]))))
