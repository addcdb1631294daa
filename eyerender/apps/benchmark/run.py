"""The benchmark: run every extractor on every image of a folder, then write results, a table and plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import InputError
from ...base.progress import Progress, notify
from ...base.storage.files import csv_text, write_json, write_text
from ...base.storage.lock import LOCK
from ...folders.imagefolder import STAGE, versions
from ...folders.outfolder import MARKER, refuse_non_empty, staged
from .asking import ANSWERS, Answers, ExtractorResults, ask_extractors, code_digest, image_key, task_of
from .checks import RESULTS_SCHEMA, Requirement, compare_with, problems_of, read_results
from .conditions import CONDITIONS, balanced
from .failurekinds import KINDS, kind_of
from .film import film_results, film_row, load_film
from .folder import load_labelled, with_edge
from .labelled import BenchImage
from .options import BenchOptions
from .page import Thumbnail, write_bench_report
from .paired import common_errors, pairs_of
from .registry import ExtractorCommand, defaults, resolve
from .results import digest_of, entry_of, gammas_of, row_of, times_of
from .summary import FACTORS, failures_by_kind

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

    Until these are written, the output folder holds the answers so far, from which the same call resumes.

    >>> er.apps.bench_extractors("out", "bench", ["own-fast"])  # doctest: +SKIP

    Args:
        folder: the labelled images.
        output: the folder that receives the results.
        extractors: an installed name, `module:callable` (see `Extractor`), `onnx:FILE`, or a command line, each
            optionally after `NAME=`; names must differ. By default all installed ones; the results list those that
            cannot run here, with the reason.
        options: jobs, time limits, checks and the like.
        progress: called with (answers, answers in all, note).
        changes: fields of `BenchOptions` by name, instead of those of `options`.

    Returns:
        The content of results.json (schema eyerender/bench-extractors/3, or eyerender/bench-film/1 for a film).

    Raises:
        InputError: the folder cannot be used, two extractors share a name, there is none, or a check cannot be made.
    """
    options = replace(options, **changes)
    chosen, absent = _chosen(extractors)
    required = [Requirement.parse(text, [e.name for e in chosen]) for text in options.require]
    old = None if options.against is None else read_results(options.against)
    is_bench = options.overwrite or _is_bench(Path(output))
    refuse_non_empty(output, is_bench)
    images = load_film(Path(folder), options.gamma) if options.film else _labelled(folder, options)
    code = [code_digest(extractor, options.start_timeout_s) for extractor in chosen]
    keys = [image_key(image) for image in images]
    done, total = 0, len(chosen) * len(images)

    def step(name: str) -> None:
        nonlocal done
        done += 1
        notify(progress, done, total, f"answers, {name}")

    notify(progress, 0, total, "answers")
    with staged(output, overwrite=is_bench) as place:
        answers = Answers(Path(output) / ANSWERS, task_of(chosen, code, keys), fresh=options.fresh)
        runs = ask_extractors(chosen, images, options, answers=answers, step=step)
        if not options.film:
            runs = [_classified(run, images) for run in runs]
        data = film_results(runs) if options.film else _scored(runs, images, keys)
        data |= {"folder": Path(folder).absolute().name or str(folder), "images": len(images)}
        data |= {"gamma": gammas_of(images), "versions": versions()}
        data["not_run"] = [{"name": name, "reason": reason} for name, reason in sorted(absent.items())]
        data["required"] = [
            bar.check(entry) for bar in required for entry in data["extractors"] if bar.name in ("", entry["name"])
        ]
        data["against"] = [] if old is None else compare_with(old, data, str(options.against))
        data["problems"] = problems_of(data, gated=bool(required or old))
        rows = [(film_row if options.film else row_of)(run, score) for run in runs for score in run.scores]
        if not options.film:
            write_bench_report(place / REPORT, data, rows, [one for run in runs for one in _thumbnails(run, images)])
        write_text(place / TABLE, csv_text(list(rows[0]), [list(row.values()) for row in rows]))
        write_json(place / TIMES, times_of(runs))
        write_json(place / RESULTS, data)
    return data


def _labelled(folder: str | Path, options: BenchOptions) -> list[BenchImage]:
    """Load the images of a labelled folder, or every tenth of them, and measure the edges of their pupils."""
    images = load_labelled(folder, options.gamma, eye_error_mm=options.eye_error_mm, pupil_class=options.pupil_class)
    if options.quick:
        chosen_rows = balanced([i.conditions for i in images], [i.subject or i.name for i in images])
        images = [images[k] for k in chosen_rows]
    return [with_edge(image) for image in images]


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


def _scored(runs: Sequence[ExtractorResults], images: Sequence[BenchImage], keys: Sequence[str]) -> dict[str, Any]:
    """Return what results.json holds of labelled images, without its checks."""
    return {
        "schema": RESULTS_SCHEMA,
        "with_pupil": sum(image.shows_pupil for image in images),
        "centres_only": sum(image.centre_px is not None for image in images),
        "image_digests": {image.name: digest_of(image, key) for image, key in zip(images, keys, strict=True)},
        "edge": _edge_summary(images),
        "factors": {name: {"what": what, "unit": unit} for name, (what, unit) in FACTORS.items()},
        "failure_kinds": dict(KINDS),
        "conditions": {
            name: {"what": what, "images": [i.name for i in images if name in i.conditions]}
            for name, what in CONDITIONS.items()
        },
        "extractors": [entry_of(run, images) for run in runs],
        "common": common_errors(runs),
        "pairs": pairs_of(runs),
    }


def _classified(run: ExtractorResults, images: Sequence[BenchImage]) -> ExtractorResults:
    """Add to every wrong ellipse the kind of object that it shows."""
    scores = []
    for s, image in zip(run.scores, images, strict=True):
        if s.outcome in ("wrong", "false") and s.ellipse is not None and not s.by_centre:
            s = replace(s, kind=kind_of(s.ellipse, image, *image.pixels()))
        scores.append(s)
    return replace(run, scores=tuple(scores))


def _thumbnails(run: ExtractorResults, images: Sequence[BenchImage]) -> list[Thumbnail]:
    """Return crops of the first images of every kind of failure, the most frequent kinds first."""
    named, out = {image.name: image for image in images}, []
    for (outcome, reason), scores in sorted(failures_by_kind(run.scores).items(), key=lambda item: -len(item[1])):
        for s in scores[:THUMBNAILS]:
            image = named[s.image]
            text = f"{outcome}: {reason}; {image.name}"
            name = run.extractor.name
            out.append(Thumbnail(extractor=name, text=text, image=image.grey(), truth=image.pupil, found=s.ellipse))
    return out


def _edge_summary(images: Sequence[BenchImage]) -> dict[str, Any]:
    good = [image.edge for image in images if image.edge is not None]
    return {
        "source": "the folder's parameters" if any(i.known for i in images) else "measured along the true outline",
        "n": len(good),
        **{
            name: float(np.median([getattr(edge, name) for edge in good])) if good else None
            for name in ("noise_dn", "step_dn", "sigma_px")
        },
    }


def _is_bench(output: Path) -> bool:
    """Return whether a folder holds files of a benchmark, finished or interrupted, and nothing else."""
    try:
        found = {p.name for p in output.iterdir() if not p.name.startswith((STAGE, LOCK))}
    except OSError:
        return False
    return bool(found & {RESULTS, ANSWERS}) and found <= {REPORT, RESULTS, TABLE, TIMES, ANSWERS, MARKER}
