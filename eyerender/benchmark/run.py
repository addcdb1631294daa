"""The bench: run every extractor over every image of a folder, then write figures, a table and plots."""

from __future__ import annotations

import csv
import math
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import EyerenderError, InputError
from ..folders.imagefile import read_any_image
from ..folders.imagefolder import versions
from ..folders.outfolder import refuse_non_empty, staged
from ..progress import Progress
from ..report.benchmark import Thumbnail, write_bench_report
from ..storage.files import write_json
from .bound import Edge, edge_of
from .folder import LabelledImage, load_labelled
from .process import ExtractorProcess, Failed
from .protocol import Greeting, Request
from .registry import ExtractorCommand, defaults, resolve
from .score import Score, failed, score
from .summary import FACTORS, breakdown, failure_kind, failures, summarise

SCHEMA = "eyerender/bench-extractors/1"
REPORT, RESULTS, TABLE = "report.html", "results.json", "results.csv"
# Consecutive deaths after which an extractor is not started again.
PATIENCE = 3
THUMBNAILS = 4  # pictures of each kind of failure of an extractor
START_S = 60.0


@dataclass(frozen=True, slots=True)
class Run:
    """Results of one extractor: its greeting (None when it never came), and a score per image."""

    extractor: ExtractorCommand
    greeting: Greeting | None
    scores: tuple[Score, ...]

    @property
    def reports_glints(self) -> bool:
        """Whether the extractor announced that it reports glints."""
        return self.greeting is not None and "glints" in self.greeting.reports


def bench_extractors(
    folder: str | Path,
    output: str | Path,
    extractors: Sequence[str | ExtractorCommand] | None = None,
    *,
    timeout_s: float = 30.0,
    start_timeout_s: float = START_S,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run extractors over a labelled folder and write report.html, results.json and results.csv.

    Args:
        folder: the labelled images.
        output: the folder that receives the results.
        extractors: what to run, each under its own name: an installed name, `module:callable` (see `Extractor`), or
            a command line, each perhaps after `NAME=`. By default all installed ones; the results name those that
            cannot run here, and why.
        timeout_s: longest time for an image.
        start_timeout_s: longest time until an extractor greets.
        overwrite: replace what `output` holds.
        progress: called with (done, total, note).

    Returns:
        The content of results.json (schema eyerender/bench-extractors/1).

    Raises:
        InputError: the folder cannot be used, two extractors share a name, or there is none.
    """
    absent: dict[str, str] = {}
    if extractors is None:
        chosen, absent = defaults()
    else:
        chosen = [resolve(given) if isinstance(given, str) else given for given in extractors]
    if not chosen:
        raise InputError("there is no extractor to run", source="--extractor")
    titles = [e.name for e in chosen]
    for name in titles:
        if titles.count(name) > 1:
            raise InputError(f"two extractors are called {name!r}; rename one with NAME=...", source="--extractor")
    refuse_non_empty(output, overwrite or _is_bench(Path(output)))
    images = load_labelled(folder)
    edges = [_edge(image) for image in images]
    sigmas = [e.centre_sigma_px(i.pupil) if e and i.pupil else None for e, i in zip(edges, images, strict=True)]
    factors = [_factors(image, edge) for image, edge in zip(images, edges, strict=True)]
    runs = []
    for k, extractor in enumerate(chosen):

        def step(done: int, name: str = extractor.name, before: int = k * len(images)) -> None:
            if progress is not None:
                progress(before + done, len(chosen) * len(images), name)

        step(0)
        runs.append(run_extractor(extractor, images, timeout_s=timeout_s, start_timeout_s=start_timeout_s, step=step))
    data = {
        "schema": SCHEMA,
        "folder": Path(folder).name or str(folder),
        "images": len(images),
        "with_pupil": sum(image.pupil is not None for image in images),
        "timeout_s": timeout_s,
        "versions": versions(),
        "machine": {"system": platform.platform(), "processor": _processor(), "threads": 1},
        "edge": _edge_summary(edges, images),
        "factors": {name: {"what": what, "unit": unit} for name, (what, unit) in FACTORS.items()},
        "extractors": [_entry(run, images, sigmas, factors) for run in runs],
        "not_run": [{"name": name, "reason": reason} for name, reason in sorted(absent.items())],
    }
    rows = [_row(run, k, images[k], sigmas[k], factors[k]) for run in runs for k in range(len(images))]
    with staged(output, overwrite=overwrite or _is_bench(Path(output))) as place:
        _write_csv(place / TABLE, rows)
        write_bench_report(place / REPORT, data, rows, [one for run in runs for one in _thumbnails(run, images)])
        write_json(place / RESULTS, data)
    return data


def run_extractor(
    extractor: ExtractorCommand,
    images: Sequence[LabelledImage],
    *,
    timeout_s: float,
    start_timeout_s: float = START_S,
    step: Callable[[int], None] = lambda _done: None,
) -> Run:
    """Run one extractor over all images; its scores include every failure."""
    process: ExtractorProcess | None = None
    greeting: Greeting | None = None
    scores: list[Score] = []
    deaths, given_up = 0, ""
    try:
        for k, image in enumerate(images):
            reports = greeting.reports if greeting else ()
            if given_up:
                scores.append(failed(image, given_up, "glints" in reports))
                continue
            try:
                if process is None or not process.alive:
                    process = ExtractorProcess(extractor.argv, start_timeout_s=start_timeout_s, timeout_s=timeout_s)
                    greeting = process.greeting
                request = Request(k, str(image.path.resolve()), image.bit_depth, image.hints)
                reply, seconds = process.ask(request)
                scores.append(score(image, reply, seconds, process.greeting.reports))
                deaths = 0
            except Failed as failure:
                deaths += 1
                scores.append(failed(image, str(failure), "glints" in reports))
                if greeting is None:
                    given_up = str(failure)
                elif deaths >= PATIENCE:
                    given_up = f"not asked after {PATIENCE} failures in a row, the last: {failure}"
            step(k + 1)
    finally:
        if process is not None:
            process.close()
    step(len(images))
    return Run(extractor, greeting, tuple(scores))


def _edge(image: LabelledImage) -> Edge | None:
    glints: Floats = np.array([g.xy_px for g in image.glints]).reshape(-1, 2)
    grey = read_any_image(image.path)[0] if not image.known else np.zeros((0, 0))
    return edge_of(grey, image.bit_depth, image.pupil, image.visible, glints, image.known)


def _thumbnails(run: Run, images: Sequence[LabelledImage]) -> list[Thumbnail]:
    """Pictures of the first images of every kind of failure, the most frequent kinds first."""
    kinds: dict[tuple[str, str], list[int]] = {}
    for k, s in enumerate(run.scores):
        if s.outcome not in ("right", "absent"):
            kinds.setdefault((s.outcome, failure_kind(s)), []).append(k)
    out = []
    for (outcome, reason), which in sorted(kinds.items(), key=lambda item: -len(item[1])):
        for k in which[:THUMBNAILS]:
            image, _, _ = read_any_image(images[k].path)
            text = f"{outcome}: {reason}; {images[k].name}"
            out.append(
                Thumbnail(
                    extractor=run.extractor.name,
                    text=text,
                    image=image,
                    truth=images[k].pupil,
                    found=run.scores[k].ellipse,
                )
            )
    return out


def _factors(image: LabelledImage, edge: Edge | None) -> dict[str, float]:
    """Possible causes of an error; noise and blur as the folder states them, else as measured."""
    out = dict(image.factors)
    if image.known:
        out |= {"noise_dn": image.known["noise_dn"], "blur_px": image.known["blur_px"]}
    elif edge is not None:
        out |= {"noise_dn": edge.noise_dn, "blur_px": math.sqrt(max(edge.sigma_px**2 - 1.0 / 12.0, 0.0))}
    if edge is not None:
        out["contrast_to_noise"] = abs(edge.step_dn) / edge.noise_dn
    return out


def _edge_summary(edges: Sequence[Edge | None], images: Sequence[LabelledImage]) -> dict[str, Any]:
    good = [e for e in edges if e is not None]
    return {
        "source": "the folder's parameters" if any(i.known for i in images) else "measured along the true outline",
        "n": len(good),
        "noise_dn": float(np.median([e.noise_dn for e in good])) if good else None,
        "step_dn": float(np.median([e.step_dn for e in good])) if good else None,
        "sigma_px": float(np.median([e.sigma_px for e in good])) if good else None,
    }


def _entry(
    run: Run, images: Sequence[LabelledImage], sigmas: Sequence[float | None], factors: Sequence[dict[str, float]]
) -> dict[str, Any]:
    greeting = run.greeting
    return {
        "name": run.extractor.name,
        "given": run.extractor.given,
        "says": greeting.name if greeting else None,
        "conventions": greeting.conventions.to_mapping() if greeting else None,
        "reports": list(greeting.reports) if greeting else None,
        "summary": summarise(run.scores, sigmas, run.reports_glints),
        "breakdown": breakdown(run.scores, sigmas, factors, run.reports_glints),
        "failures": failures(run.scores, images),
    }


def _row(run: Run, k: int, image: LabelledImage, sigma: float | None, factors: dict[str, float]) -> dict[str, Any]:
    """One line of the CSV."""
    s = run.scores[k]
    dx, dy = s.offset_px or (None, None)
    da, db = s.axes_px or (None, None)
    g = s.glints
    return {
        "extractor": run.extractor.name,
        "image": image.name,
        "outcome": s.outcome,
        "reason": s.reason,
        "centre_x_px": dx,
        "centre_y_px": dy,
        "centre_px": s.centre_px,
        "bound_sigma_px": sigma,
        "semi_axis_a_px": da,
        "semi_axis_b_px": db,
        "angle_deg": s.angle_deg,
        "iou": s.iou,
        "boundary_px": s.boundary_px,
        "confidence": s.confidence,
        "glints_true": g.true if g else None,
        "glints_reported": g.reported if g else None,
        "glints_matched": len(g.errors_px) if g else None,
        "glints_named": g.named if g else None,
        "glints_swapped": g.swapped if g else None,
        "glint_px": float(np.mean([np.hypot(*e) for e in g.errors_px])) if g and g.errors_px else None,
        "cpu_ms": None if s.cpu_s is None else 1e3 * s.cpu_s,
        "wall_ms": None if s.wall_s is None else 1e3 * s.wall_s,
        "round_trip_ms": None if s.trip_s is None else 1e3 * s.trip_s,
        **{name: factors.get(name) for name in FACTORS},
    }


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    try:
        with open(path, "w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise EyerenderError(f"{path}: cannot be written ({error.strerror or error})") from None


def _is_bench(output: Path) -> bool:
    """Whether a folder holds a bench's files and nothing else."""
    try:
        return {p.name for p in output.iterdir()} == {REPORT, RESULTS, TABLE}
    except OSError:
        return False


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return f"{names[0] if names else platform.processor() or platform.machine()}, {os.cpu_count()} cores"
