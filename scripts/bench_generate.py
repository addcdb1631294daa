#!/usr/bin/env python3
"""Bench of dataset runs: rate, time outside rendering, syncing, scaling over workers, memory, disk, killed runs.

    bench_generate.py [--quick] [--json F] [--backend llvm|cuda] [--against CHECKOUT]

Images are 640 x 480 px at 4 samples per pixel, with E2, two LEDs, labels and files. Rates are measured after every
worker has made its first samples, so they exclude starting and compiling. The time outside rendering is CPU time, so
other work on the machine has little influence. --quick makes fewer images and kills. The
exit code is 1 if a `must` is missed.

With --against, only images with a region are measured, here and in another checkout of this project in turns: the
command `generate` with `dataset_region`, new subjects in every run. A long and a short run are compared, so what a run
takes besides its images does not count.
"""

from __future__ import annotations

import hashlib
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from _bench import Report, Row, options_of, resident_mib, row, single_threaded

single_threaded()

import numpy as np  # noqa: E402
import yaml  # noqa: E402

from eyerender.dataset import shard  # noqa: E402
from eyerender.dataset.maker import Maker  # noqa: E402
from eyerender.dataset.plan import Plan  # noqa: E402
from eyerender.dataset.pool import LocalPool  # noqa: E402
from eyerender.dataset.realise import frames_of  # noqa: E402
from eyerender.dataset.shard import Staged, commit, write_shard  # noqa: E402
from eyerender.dataset.spec import DatasetSpec, find_dataset  # noqa: E402
from eyerender.dataset.worker import Job  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]


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

    def rows(self) -> Iterable[Row]:
        """All rows, as they are measured."""
        yield from self.apart()
        yield from self.rates()
        yield from self.memory()
        yield from self.kills()

    def against(self, other: Path) -> Iterable[Row]:
        """Images a second with a region, 640 x 480 px, 4 samples, 2 workers, here and in another checkout.

        Both make `dataset_region` as it is in the other, which may be older.
        """
        text = (other / "scenes" / "dataset_region.yaml").read_text(encoding="utf-8")
        data = yaml.safe_load(text)
        turns, few, many = (1, 4, 12) if self.small else (4, 8, 40)
        trees = {"here": ROOT, "there": other.resolve()}
        found: dict[str, list[tuple[float, float]]] = {name: [] for name in trees}
        for turn in range(turns):
            for name, tree in trees.items():
                short, long = (_generated(tree, data, self.backend, n, 1000 * turn + n) for n in (few, many))
                found[name].append(tuple((b - a) / (many - few) for a, b in zip(short, long, strict=True)))  # type: ignore[arg-type]
        here, there = (np.array(found[name]) for name in trees)
        wall, cpu = (there / here).T
        yield row("with a region, 640x480, 4 samples, 2 workers", 1 / np.median(here[:, 0]), "images/s")
        yield row("the same, CPU", np.median(here[:, 1]), "s/image")
        yield row("the same in the other checkout", 1 / np.median(there[:, 0]), "images/s")
        yield row("the same, CPU", np.median(there[:, 1]), "s/image")
        yield row(
            f"images a second, here / there: median of {turns}", np.median(wall), "ratio", must=1.5, at_least=True
        )
        yield row("the same, least", np.min(wall), "ratio")
        yield row("CPU of an image, there / here: median", np.median(cpu), "ratio")

    def rates(self) -> Iterable[Row]:
        """Images a second of one and of two workers of one thread each."""
        count = 24 if self.small else 96
        rates = {}
        for workers in (1, 2):
            made = plan(count * workers, count)
            with tempfile.TemporaryDirectory() as folder:
                clock = Clock(workers)
                job = Job.of(made, frames_of(made), Path(folder), self.backend, 1)
                lost = LocalPool(job, workers).run(range(workers), clock)
                if lost:
                    raise RuntimeError(str(lost))
                rates[workers] = clock.rate
        yield row("one worker of one thread", rates[1], "images/s")
        yield row("two workers of one thread each", rates[2], "images/s", aim=8.0, at_least=True)
        yield row("two workers against one", rates[2] / rates[1], "ratio", must=1.8, at_least=True)

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


def _generated(tree: Path, data: dict[str, Any], backend: str, count: int, seed: int) -> tuple[float, float]:
    """Seconds of the clock and of the processors that `generate` takes in a checkout for images with a region."""
    image = {**data["scene"].get("image", {}), "window_px": [640, 480], "spp": 4}
    data = {
        **data,
        "count": count,
        "subjects": min(8, count),
        "shard_size": max(count // 4, 1),
        "seed": seed,
        "scene": {**data["scene"], "image": image},
    }
    with tempfile.TemporaryDirectory() as place:
        spec = Path(place) / "spec.yaml"
        spec.write_text(yaml.safe_dump(data), encoding="utf-8")
        command = [sys.executable, "-m", "eyerender", "generate", str(spec), f"{place}/out", "--workers", "2"]
        start, used = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        subprocess.run([*command, "--backend", backend], check=True, capture_output=True, env=environment, cwd=place)
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
        return time.perf_counter() - start, cpu


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
    return report.finish(options.json, ("eyerender", "mitsuba", "drjit", "numpy", "pillow"))


if __name__ == "__main__":
    sys.exit(main())
