#!/usr/bin/env python3
"""Bench of dataset runs: people, time outside rendering, syncing, scaling over workers, memory, disk, killed runs.

    bench_generate.py [--quick] [--json F] [--backend llvm|cuda] [--against CHECKOUT]

Four recipes of people (scripts/recipes) are measured with an eighth of their resolution and 4 samples per pixel, with
half of it and 4 samples, and as they are: CPU per image of all threads of one worker, after the first images of a
subject, and the share that does not depend on pixels, from a straight line over the number of samples. The file of
--json also has the top rows of a profile. The rest is made with `dataset_quick` at 640 x 480 px and 4 samples per
pixel. Rates exclude starting and compiling. --quick measures one recipe and makes fewer images and kills. The exit
code is 1 if a `must` is missed.

With --against, only the recipes are measured, here and in another checkout of this project in turns.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args
from unittest.mock import patch

from _bench import Report, Row, options_of, resident_mib, row, single_threaded
from _people import recipe

single_threaded()

import numpy as np
import yaml

from eyerender.dataset import shard
from eyerender.dataset.done import sum_of
from eyerender.dataset.estimate import estimate
from eyerender.dataset.maker import Maker
from eyerender.dataset.plan import Plan
from eyerender.dataset.pool import LocalPool
from eyerender.dataset.realise import frames_of
from eyerender.dataset.run import generate
from eyerender.dataset.shard import Staged, commit, write_shard
from eyerender.dataset.spec import DatasetSpec, GeometryKind, find_dataset
from eyerender.dataset.worker import Job
from eyerender.folders.imagefile import write_picture

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "scripts" / "recipes"
RECIPES = ("people_openeds", "people_nvgaze", "people_eyelink", "people_pupil_core")
SIZES: dict[str, tuple[int, int | None]] = {"1/8, 4 samples": (8, 4), "1/2, 4 samples": (2, 4), "as shipped": (1, None)}
"""Divisor of the resolution, and samples per pixel (the recipe's own if None)."""


def plan(count: int, shard_size: int, window: tuple[int, int] = (640, 480), spp: int = 4) -> Plan:
    """The quick dataset at another size; few identities, whose textures cost a second or two each."""
    data = DatasetSpec.load(find_dataset("dataset_quick")).to_mapping()
    data |= {"count": count, "shard_size": shard_size, "subjects": min(8, count)}
    data["scene"]["image"] = {"window_px": list(window), "spp": spp}
    data["scene"]["look"]["iris_seed"] = 1
    return Plan.of(DatasetSpec.from_mapping(data))


class Clock:
    """Events of an engine: when samples are made, by worker start-up left out."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self.by_shard: dict[int, int] = {}
        self.start: float | None = None
        self.images = 0
        self.end = 0.0

    def ready(self, backend: dict[str, Any], worker: str) -> None:
        """A worker can render."""

    def sample(self, shard: int, samples: int, images: int) -> None:
        """Count from the moment at which as many shards as workers have three samples."""
        self.by_shard[shard] = samples
        now = time.perf_counter()
        if self.start is not None:
            self.images += images
            self.end = now
        elif sum(n >= 3 for n in self.by_shard.values()) >= self.workers:
            self.start = now

    def staged(self, staged: Staged, worker: str) -> None:
        """Nothing is kept."""
        shutil.rmtree(staged.stage)

    def retry(self, shard: int, reason: str, tries: int) -> None:
        """No worker may die in a bench."""
        raise RuntimeError(f"shard {shard}: {reason}")

    @property
    def rate(self) -> float:
        """Images a second."""
        return self.images / (self.end - (self.start or 0.0))


class Bench:
    """The measurements; `small` for --quick."""

    def __init__(self, backend: str, small: bool) -> None:
        self.backend, self.small = backend, small
        self.profiles: dict[str, Any] = {}

    def rows(self) -> Iterable[Row]:
        """All rows, as they are measured."""
        yield from self.people()
        yield from self.scaling()
        yield from self.prediction()
        yield from self.apart()
        yield from self.geometry()
        yield from self.memory()
        yield from self.kills()

    def people(self) -> Iterable[Row]:
        """CPU per image of each recipe and size, and what of it does not depend on pixels."""
        for name in self.recipes:
            found = {size: self.made(ROOT, name, size) for size in SIZES}
            samples = {size: _samples(name, size) for size in SIZES}
            small, large = "1/8, 4 samples", "1/2, 4 samples"
            rate = (found[large]["cpu_s"] - found[small]["cpu_s"]) / (samples[large] - samples[small])
            fixed = found[small]["cpu_s"] - rate * samples[small]
            for size, one in found.items():
                self.profiles[f"{name}, {size}"] = one["profile"]
                yield row(f"{name}, {size}: CPU", one["cpu_s"], "s/image")
                yield row(f"{name}, {size}: one worker", 1.0 / one["wall_s"], "images/s")
                yield row(f"{name}, {size}: not of pixels", 100.0 * fixed / one["cpu_s"], "%")
                yield row(f"{name}, {size}: memory of the worker", one["memory_mib"], "MiB", must=800.0)

    def against(self, other: Path) -> Iterable[Row]:
        """CPU per image of each recipe and size, here and in another checkout in turns: the least of each."""
        trees = {"here": ROOT, "there": other.resolve()}
        for name in self.recipes:
            for size in SIZES:
                least = dict.fromkeys(trees, np.inf)
                for _ in range(1 if self.small else 3):
                    for place, tree in trees.items():
                        least[place] = min(least[place], self.made(tree, name, size)["cpu_s"])
                for place, cpu in least.items():
                    yield row(f"{name}, {size}: CPU {place}", cpu, "s/image")
                yield row(f"{name}, {size}: here / there", least["here"] / least["there"], "ratio")

    @property
    def recipes(self) -> tuple[str, ...]:
        """Names of the recipes."""
        return RECIPES[:1] if self.small else RECIPES

    def made(self, tree: Path, name: str, size: str) -> dict[str, Any]:
        """What `_people.py` measures in a process of its own with the package of a checkout."""
        divisor, spp = SIZES[size]
        images, warm = (2, 2) if self.small else (8, 3)
        job = {"recipe": str(FOLDER / f"{name}.yaml"), "divisor": divisor, "spp": spp}
        job |= {"images": images, "warm": warm, "backend": self.backend}
        command = [sys.executable, str(ROOT / "scripts" / "_people.py"), json.dumps(job)]
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if run.returncode:
            raise RuntimeError(run.stderr)
        return dict(json.loads(run.stdout.splitlines()[-1]))

    def scaling(self) -> Iterable[Row]:
        """Images a second of one and of two workers of one thread each, with people."""
        count = 6 if self.small else 24
        rates = {}
        for workers in (1, 2):
            made = Plan.of(DatasetSpec.from_mapping(recipe(FOLDER / f"{RECIPES[0]}.yaml", 2, 4, count, workers)))
            rates[workers] = _rate(made, workers, self.backend)
        yield row("people_openeds, 1/2, 4 samples: one worker of one thread", rates[1], "images/s")
        yield row("the same, two workers", rates[2], "images/s")
        yield row("two workers against one", rates[2] / rates[1], "ratio", must=1.85, at_least=True)

    def prediction(self) -> Iterable[Row]:
        """The time that a dry run predicts for one worker, over what the run takes."""
        count = 8 if self.small else 24
        made = Plan.of(DatasetSpec.from_mapping(recipe(FOLDER / f"{RECIPES[0]}.yaml", 2, 4, count)))
        foretold = estimate(made, backend=self.backend, workers=1, measure=True)["seconds"]
        with tempfile.TemporaryDirectory() as place:
            start = time.perf_counter()
            generate(made, f"{place}/out", backend=self.backend, workers=1)
            spent = time.perf_counter() - start
        yield row("time that a dry run predicts / time of the run", foretold / spent, "ratio")
        yield row("the prediction is off by", 100.0 * abs(foretold / spent - 1.0), "%", aim=20.0)

    def apart(self) -> Iterable[Row]:
        """What an image takes besides rendering, what syncing takes of a run, and bytes on disk."""
        count = 20 if self.small else 60
        made = plan(count, count)
        maker = Maker(made, 1, backend=self.backend, threads=1)  # type: ignore[arg-type]
        maker.make(0)
        traced, inside, begin = deque[Any](), 0.0, maker.renderer.begin

        def kept(*arguments: Any, **options: Any) -> Any:
            traced.append(begin(*arguments, **options))
            return traced[-1]

        maker.renderer.begin = kept  # type: ignore[method-assign]
        start = time.process_time()
        for sample in made.spec.shard_samples(0):
            maker.make(sample)
        inside = time.process_time() - start
        # The same samples again, with the windows that were rendered: what is left is everything else.
        maker.renderer.begin = lambda *_, **__: traced.popleft()  # type: ignore[method-assign]
        with tempfile.TemporaryDirectory() as folder, syncing_timed() as syncing:
            start, clock = time.process_time(), time.perf_counter()
            staged = write_shard(maker, Path(folder), 0, lambda *_: None)
            apart = time.process_time() - start
            size = sum(p.stat().st_size for p in Path(staged.stage).rglob("*") if p.is_file())
            commit(Path(folder), staged)
            whole = time.perf_counter() - clock + inside
        n = staged.images
        yield row("making an image in memory, CPU", 1e3 * inside / n, "ms/image")
        yield row("everything but rendering, CPU", 1e3 * apart / n, "ms/image", must=35.0)
        yield row(f"a shard of {n} images, synced", whole, "s")
        yield row("the same without syncing", whole - syncing[0], "s")
        yield row("what syncing adds", 100 * syncing[0] / (whole - syncing[0]), "%", must=3.0)
        yield row("on disk, masks and labels included", size / n, "bytes")

    def geometry(self) -> Iterable[Row]:
        """CPU of the additional work for each kind of geometry, repeated and timed alone, over that of an image."""
        count = 3 if self.small else 8
        data = recipe(FOLDER / f"{RECIPES[0]}.yaml", 1, None, 1)
        plain, maker = 0.0, None
        for kind in ("", *get_args(GeometryKind)):
            labels = {**data.get("labels", {}), "geometry": [kind] if kind else None}
            made = Plan.of(DatasetSpec.from_mapping({**data, "labels": labels}))
            maker = maker or Maker(made, 1, backend=self.backend, threads=1)  # type: ignore[arg-type]
            maker.plan = made
            maker.make(0)
            with tempfile.TemporaryDirectory() as folder, geometry_timed() as spent:
                for _ in range(count):
                    start = time.process_time()
                    pictures = maker.make(0).images[0].pictures
                    if kind:
                        start = time.process_time()
                        write_picture(Path(folder) / kind, pictures[kind])
                        sum_of(Path(folder) / kind)
                        spent[-1] += time.process_time() - start
                    else:
                        spent.append(time.process_time() - start)
            if kind:
                share = statistics.median(spent) / plain
                yield row(f"{kind}, written and hashed: CPU", 100.0 * share, "%", must=5.0)
            else:
                plain = statistics.median(spent)
                yield row("people_openeds, as shipped, the same image again: CPU", 1e3 * plain, "ms/image")

    def memory(self) -> Iterable[Row]:
        """Growth of a worker's resident memory."""
        count = 600 if self.small else 5000
        made = plan(count, count, window=(96, 72), spp=1)
        maker = Maker(made, 1, backend=self.backend, threads=1)  # type: ignore[arg-type]
        with tempfile.TemporaryDirectory() as folder:
            sizes: list[float] = []
            write_shard(maker, Path(folder), 0, lambda k, _n: sizes.append(resident_mib()) if k % 100 == 0 else None)
        yield row("resident memory of a worker", sizes[-1], "MiB")
        yield row(f"its growth over {count} images", sizes[-1] - sizes[1], "MiB", must=30.0)

    def kills(self) -> Iterable[Row]:
        """Runs killed at random instants; files that differ from an undisturbed run's."""
        kills, seed = (3, 1) if self.small else (20, 1)
        data = plan(64, 4, window=(96, 72), spp=1).spec.to_mapping()
        draws = random.Random(seed)
        with tempfile.TemporaryDirectory() as place:
            spec = Path(place) / "spec.yaml"
            spec.write_text(yaml.safe_dump(data), encoding="utf-8")
            command = [sys.executable, "-m", "eyerender", "generate", str(spec), "--backend", self.backend]
            command += ["--workers", "2"]
            start = time.perf_counter()
            subprocess.run([*command, f"{place}/whole"], check=True, capture_output=True)
            length = time.perf_counter() - start
            killed = 0
            while killed < kills:
                folder = f"{place}/killed{killed // 4}"  # each folder is killed four times, then finished
                with subprocess.Popen([*command, folder], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
                    try:
                        run.wait(draws.uniform(0.0, length))
                    except subprocess.TimeoutExpired:
                        run.kill()
                killed += 1
            differ = 0
            whole = _tree(Path(place) / "whole")
            for k in range(-(-kills // 4)):
                subprocess.run([*command, f"{place}/killed{k}"], check=True, capture_output=True)
                other = _tree(Path(place) / f"killed{k}")
                differ += sum(whole.get(name) != other.get(name) for name in {*whole, *other})
        yield row(f"files that differ after {kills} kills", differ, "files", must=0)


@contextmanager
def geometry_timed() -> Iterator[list[float]]:
    """A list that gets the seconds that geometry of pixels takes for each image that is made while the block runs.

    They are those of masks with geometry without those of masks alone.
    """
    # Importing the renderer loads Mitsuba, which must not happen before a backend has been chosen.
    from eyerender.rendering import renderer
    from eyerender.rendering.output.geometry import geometry_of, window_hits
    from eyerender.rendering.output.labels import part_labels

    spent: list[float] = []

    def timed(bound: Any, job: Any, scene: Any) -> Any:
        window_hits(bound, job, scene)()  # whatever was launched before it is done now
        start = time.process_time()
        part_labels(bound, job.window)()
        masks = time.process_time()
        geometry_of(job, window_hits(bound, job, scene)())
        spent.append(time.process_time() - masks - (masks - start))
        return window_hits(bound, job, scene)

    with patch.object(renderer, "window_hits", timed):
        yield spent


@contextmanager
def syncing_timed() -> Iterator[list[float]]:
    """A list whose one number grows by the seconds that shards wait for syncs while the block runs."""
    spent, real = [0.0], {name: getattr(shard, name) for name in ("sync_tree", "sync_folder", "make_folder")}

    def timed(sync: Callable[[Path], Any]) -> Callable[[Path], Any]:
        def call(path: Path) -> Any:
            start = time.perf_counter()
            try:
                return sync(path)
            finally:
                spent[0] += time.perf_counter() - start

        return call

    for name, sync in real.items():
        setattr(shard, name, timed(sync))
    try:
        yield spent
    finally:
        for name, sync in real.items():
            setattr(shard, name, sync)


def _rate(made: Plan, workers: int, backend: str) -> float:
    """Images a second of so many workers of one thread, each with a shard."""
    with tempfile.TemporaryDirectory() as folder:
        clock = Clock(workers)
        lost = LocalPool(Job.of(made, frames_of(made), Path(folder), backend, 1), workers).run(range(workers), clock)
        if lost:
            raise RuntimeError(str(lost))
        return clock.rate


def _samples(name: str, size: str) -> int:
    """Number of samples of an image of a recipe."""
    divisor, spp = SIZES[size]
    made = Plan.of(DatasetSpec.from_mapping(recipe(FOLDER / f"{name}.yaml", divisor, spp, 2)))
    scene = made.draw(0).build()
    (_, _, width, height), *_ = scene.windows().values()
    return int(width * height * scene.spec.image.spp)


def _tree(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in folder.rglob("*")
        if p.is_file() and p.name not in ("log.jsonl", "done.json") and not p.name.startswith(".eyerender-lock")
    }


def main() -> int:
    """Measure, print, write."""
    parser = options_of(__doc__, "fewer images and kills")
    parser.add_argument("--backend", choices=["auto", "llvm", "cuda"], default="auto")
    parser.add_argument("--against", metavar="CHECKOUT", type=Path, help="compare with another checkout")
    options = parser.parse_args()
    report, bench = Report(), Bench(options.backend, options.quick)
    report.extend(bench.rows() if options.against is None else bench.against(options.against))
    code = report.finish(options.json, ("eyerender", "mitsuba", "drjit", "numpy", "pillow"))
    if options.json is not None and bench.profiles:
        found = json.loads(options.json.read_text(encoding="utf-8"))
        options.json.write_text(json.dumps({**found, "profiles": bench.profiles}, indent=1) + "\n", encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())
