"""The benchmark: run every extractor on every image of a folder, then write results, a table and plots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import InputError
from ...base.progress import Progress, notify
from ...base.storage.files import write_json
from ...folders.imagefile import read_any_image
from ...folders.imagefolder import versions
from ...folders.outfolder import refuse_non_empty, staged
from ...scene.parts import IRIS, PUPIL
from .answercache import AnswerCache, check_reference, image_key
from .asking import Run, ask_extractors
from .bound import Edge, edge_of, is_bounded
from .checks import RESULTS_SCHEMA, Requirement, compare_with, problems_of, read_results
from .conditions import CONDITIONS, balanced
from .failurekinds import KINDS, kind_of
from .folder import LabelledImage, load_labelled
from .options import BenchOptions
from .page import Thumbnail, write_bench_report
from .paired import common_errors, pairs_of
from .registry import ExtractorCommand, defaults, resolve
from .results import digest_of, entry_of, gammas_of, row_of, times_of, write_csv
from .summary import FACTORS, failure_kind

REPORT, RESULTS, TABLE, TIMES = "report.html", "results.json", "results.csv", "times.json"
THUMBNAILS = 4  # pictures of each kind of failure of an extractor


def bench_extractors(
    folder: str | Path,
    output: str | Path,
    extractors: Sequence[str | ExtractorCommand] | None = None,
    options: BenchOptions = BenchOptions(),
    *,
    progress: Progress | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Run extractors on a labelled folder; write report.html, results.json, results.csv and times.json.

    >>> er.apps.bench_extractors("out", "bench", ["own-fast"])  # doctest: +SKIP

    Args:
        folder: the labelled images.
        output: the folder that receives the results.
        extractors: an installed name, `module:callable` (see `Extractor`), or a command line, each optionally after
            `NAME=`; names must differ. By default all installed ones; the results list those that cannot run here, with
            the reason.
        options: jobs, time limits, checks and the like.
        progress: called with (done, total, note).
        changes: fields of `BenchOptions` by name, instead of those of `options`.

    Returns:
        The content of results.json (schema eyerender/bench-extractors/3).

    Raises:
        InputError: the folder cannot be used, two extractors share a name, there is none, or a check cannot be made.
    """
    options = replace(options, **changes)
    chosen, absent = _chosen(extractors)
    required = [Requirement.parse(text, [e.name for e in chosen]) for text in options.require]
    old = None if options.against is None else read_results(options.against)
    is_bench = options.overwrite or _is_bench(Path(output))
    refuse_non_empty(output, is_bench)
    images = load_labelled(folder, options.gamma, eye_error_mm=options.eye_error_mm, pupil_class=options.pupil_class)
    if options.quick:
        chosen_rows = balanced([i.conditions for i in images], [i.subject or i.name for i in images])
        images = [images[k] for k in chosen_rows]
    sources = [check_reference(extractor, options.start_timeout_s) for extractor in chosen]
    keys = [image_key(image) for image in images]
    done, total = 0, len(chosen) * len(images)

    def step(name: str) -> None:
        nonlocal done
        done += 1
        notify(progress, done, total, name)

    notify(progress, 0, total, "")
    caches = [AnswerCache.of(extractor, files) for extractor, files in zip(chosen, sources, strict=True)]
    asked = ask_extractors(chosen, images, options, keys=keys, caches=caches, step=step)
    runs = [_classified(run, images) for run in asked]
    data, rows = _results(Path(folder), runs, images, keys)
    data["not_run"] = [{"name": name, "reason": reason} for name, reason in sorted(absent.items())]
    data["required"] = [
        bar.check(entry) for bar in required for entry in data["extractors"] if bar.name in ("", entry["name"])
    ]
    data["against"] = [] if old is None else compare_with(old, data, str(options.against))
    data["problems"] = problems_of(data, gated=bool(required or old))
    with staged(output, overwrite=is_bench) as place:
        write_csv(place / TABLE, rows)
        write_bench_report(place / REPORT, data, rows, [one for run in runs for one in _thumbnails(run, images)])
        write_json(place / TIMES, times_of(runs, images))
        write_json(place / RESULTS, data)
    return data


def _chosen(extractors: Sequence[str | ExtractorCommand] | None) -> tuple[list[ExtractorCommand], dict[str, str]]:
    """Return the extractors to run; if none were given, also why installed ones cannot run."""
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
    return chosen, absent


def _results(
    folder: Path, runs: Sequence[Run], images: Sequence[LabelledImage], keys: Sequence[str]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the content of results.json without its checks, and the rows of results.csv."""
    edges = [_edge(image) for image in images]
    sigmas = [
        e.centre_sigma_px(i.pupil) if e and i.pupil and is_bounded(i.visible, i.known) else None
        for e, i in zip(edges, images, strict=True)
    ]
    factors = [_factors(image, edge) for image, edge in zip(images, edges, strict=True)]
    data = {
        "schema": RESULTS_SCHEMA,
        "folder": folder.absolute().name or str(folder),
        "images": len(images),
        "with_pupil": sum(image.shows_pupil for image in images),
        "centres_only": sum(image.centre_px is not None for image in images),
        "gamma": gammas_of(images),
        "image_digests": {image.name: digest_of(image, key) for image, key in zip(images, keys, strict=True)},
        "versions": versions(),
        "edge": _edge_summary(edges, images),
        "factors": {name: {"what": what, "unit": unit} for name, (what, unit) in FACTORS.items()},
        "failure_kinds": dict(KINDS),
        "conditions": {
            name: {"what": what, "images": [i.name for i in images if name in i.conditions]}
            for name, what in CONDITIONS.items()
        },
        "extractors": [entry_of(run, images, sigmas, factors) for run in runs],
        "common": common_errors(runs),
        "pairs": pairs_of(runs),
    }
    rows = [row_of(run, k, images[k], sigmas[k], factors[k]) for run in runs for k in range(len(images))]
    return data, rows


def _edge(image: LabelledImage) -> Edge | None:
    glints: Floats = np.array([g.xy_px for g in image.glints]).reshape(-1, 2)
    grey = read_any_image(image.path)[0] if not image.known else np.zeros((0, 0))
    classes = None if image.known else image.classes()
    shows = None if classes is None else np.isin(classes, (PUPIL, IRIS))
    if shows is None and not image.known and image.visible is not None and image.visible < 1.0:
        return None  # the occluder of the outline is unknown
    return edge_of(grey, image.bit_depth, image.pupil, glints, image.known, shows)


def _classified(run: Run, images: Sequence[LabelledImage]) -> Run:
    """Add to every wrong ellipse the kind of object that it shows."""
    scores = []
    for s, image in zip(run.scores, images, strict=True):
        if s.outcome in ("wrong", "false") and s.ellipse is not None and not s.by_centre:
            s = replace(s, kind=kind_of(s.ellipse, image, read_any_image(image.path)[0], image.classes()))
        scores.append(s)
    return replace(run, scores=tuple(scores))


def _thumbnails(run: Run, images: Sequence[LabelledImage]) -> list[Thumbnail]:
    """Return crops of the first images of every kind of failure, the most frequent kinds first."""
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
    """Return possible causes of an error; noise and blur are those that the folder states, else measured."""
    out = dict(image.factors)
    if image.known:
        out |= {"noise_dn": image.known["noise_dn"], "blur_px": image.known["blur_px"]}
    elif edge is not None:
        out |= {"noise_dn": edge.noise_dn, "blur_px": math.sqrt(max(edge.sigma_px**2 - 1.0 / 12.0, 0.0))}
    if edge is not None:
        out["contrast_to_noise"] = abs(edge.step_dn) / edge.noise_dn
    if edge is not None and not image.known:
        out |= {"edge_arc_deg": edge.arc_deg, "edge_step_error": edge.step_sd_dn / abs(edge.step_dn)}
        out["edge_width_error"] = edge.sigma_sd_px / edge.sigma_px
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


def _is_bench(output: Path) -> bool:
    """Return whether a folder holds a benchmark's files and nothing else."""
    try:
        found = {p.name for p in output.iterdir()}
    except OSError:
        return False
    return {REPORT, RESULTS, TABLE} <= found <= {REPORT, RESULTS, TABLE, TIMES}
