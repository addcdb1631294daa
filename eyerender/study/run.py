"""Studies as commands: run, test the findings, write the results and the report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

from ..errors import EyerenderError, InputError
from ..eye.catalogue import load_eye
from ..imagefolder import refuse_non_empty, write_json
from ..report.study import Page, write_page
from . import (
    blignaut,
    clouds,
    conditions_page,
    errata,
    findings,
    guestrin,
    head_mounted,
    head_mounted_page,
    observers_compared,
    pages,
)
from .conditions import conditions_part
from .head_mounted import HeadMountedPart, head_mounted_part
from .literature import MODELS, VARIANTS
from .observing import ImageSettings, Kind, Observing
from .page_parts import Apart
from .replicate import BlignautPart, GuestrinPart, blignaut_part, guestrin_part
from .results import Finding, Row, write_results, write_text

Progress = Callable[[int, int, str], None]
STUDIES = ("guestrin2006", "blignaut2014", "observers", "conditions")
RUN_SCHEMA = "eyerender/study/1"
MARKER, REPORT = "study.json", "report.html"


def run_study(
    name: str,
    folder: str | Path,
    *,
    protocol: Literal["corrected", "published", "both"] = "both",
    observer: Literal["analytic", "image", "both"] | None = None,
    eyes: Sequence[str] = MODELS,
    workers: int = 1,
    spp: int | None = None,
    noise: Literal["on", "off", "both"] = "both",
    backend: Literal["auto", "cuda", "llvm"] = "auto",
    threads: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run a study and write summary.json, findings.json, CSV of both and report.html into a folder.

    A folder of the same study is run again in place; images that it holds are used again.

    Args:
        name: guestrin2006, blignaut2014, observers (both observers on the head-mounted rig), or conditions (what lies
            beyond the paper; analytic).
        folder: where the results go.
        protocol: the authors' software's reading, the corrected one, or both.
        observer: analytic features, features of rendered images, or both. Default: both for `observers`, whose only
            choice it is, else analytic.
        eyes: eye models (catalogue names or files). With E5 and `published`, its two published variants come along.
        workers: processes for the analytic part.
        spp, backend, threads: of the images.
        noise: images with the sensor's noise, without it, or both, from one rendering.
        overwrite: replace what the folder holds.
        progress: called with (done, total, note).

    Returns:
        The summary that was written.

    Raises:
        InputError: an unknown study, eye or choice, or a folder that holds something else.
    """
    if name not in STUDIES:
        raise InputError(f"{name!r} is no study; there are {', '.join(STUDIES)}")
    if not eyes or len(set(eyes)) != len(eyes):
        raise InputError("name each eye once", source="--eyes")
    for eye in eyes:
        load_eye(eye)
    observer = observer or ("both" if name == "observers" else "analytic")
    if name == "conditions" and observer != "analytic":
        raise InputError("the study 'conditions' has the analytic observer only", source="--observer")
    if name == "observers" and observer != "both":
        raise InputError("the study 'observers' compares both observers", source="--observer")
    if workers < 1:
        raise InputError("must be >= 1", source="--workers")
    settings: dict[str, Any] = {"study": name, "protocol": protocol, "observer": observer, "eyes": list(eyes)}
    if observer != "analytic":
        settings |= {"spp": spp, "sensor_noise": noise}
    folder = Path(folder)
    with _claimed(folder, settings, overwrite):
        start = time.monotonic()
        if name == "conditions":
            models = _collected(conditions_part, list(eyes), list(eyes), workers, progress)
            rows = [row for part in models for row in part.rows]
            found = conditions_page.findings(models)
            more, page = conditions_page.more(models), conditions_page.page(models, found)
        elif name == "observers":
            images = ImageSettings(folder / "images", spp, noise == "both", backend, threads, progress)
            observings = [Observing(), *(Observing(kind, images) for kind in _image_kinds(noise))]
            rows, found, more, page = _observers([head_mounted_part(eye, observings) for eye in eyes])
        else:
            protocols = ("published", "corrected") if protocol == "both" else (protocol,)
            parts: list[Any] = []
            if observer in ("analytic", "both"):
                parts += _analytic(name, _models(name, eyes, protocols), workers, progress)
            if observer in ("image", "both"):
                images = ImageSettings(folder / "images", spp, noise == "both", backend, threads, progress)
                function = guestrin_part if name == "guestrin2006" else blignaut_part
                kinds = _image_kinds(noise)
                parts += [function(eye, protocols, Observing(kind, images)) for kind in kinds for eye in eyes]
            assemble = _guestrin if name == "guestrin2006" else _blignaut
            rows, found, more, page = assemble(parts, protocols)
        more = {"settings": settings, "seconds": round(time.monotonic() - start, 2), **more}
        summary = write_results(folder, name, rows, found, more)
        if "waterfall" in more:
            write_text(folder / "waterfall.csv", _waterfall_csv(more["waterfall"]))
        write_page(folder / REPORT, page)
        return summary


def _image_kinds(noise: str) -> list[Kind]:
    """The observers of images; the one with noise first, whose rendering serves both."""
    kinds: list[tuple[Kind, str]] = [("image", "off"), ("image-noiseless", "on")]
    return [kind for kind, without in kinds if noise != without]


@contextmanager
def _claimed(folder: Path, settings: dict[str, Any], overwrite: bool) -> Iterator[None]:
    """Mark a folder as this study's while it runs; one that fails before it wrote anything leaves nothing behind.

    Raises:
        InputError: the folder holds something else.
    """
    try:
        found = json.loads((folder / MARKER).read_text(encoding="utf-8"))
        same = found.get("schema") == RUN_SCHEMA and found.get("settings", {}).get("study") == settings["study"]
    except (OSError, ValueError, AttributeError):
        same = False
    if not same:
        refuse_non_empty(folder, overwrite)
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EyerenderError(f"{folder}: cannot be written ({error.strerror or error})") from None
    done = False
    try:
        write_json(folder / MARKER, {"schema": RUN_SCHEMA, "settings": settings})
        yield
        done = True
    finally:
        if not done and not same:
            for empty in (folder / "images",):
                if empty.is_dir() and not any(empty.iterdir()):
                    empty.rmdir()
            if [p.name for p in folder.iterdir()] == [MARKER]:
                (folder / MARKER).unlink()
            if created and not any(folder.iterdir()):
                folder.rmdir()


def _models(name: str, eyes: Sequence[str], protocols: Sequence[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Eye models with their protocols; the published variants of E5 stand under their own names, never as E5."""
    out = [(eye, tuple(protocols)) for eye in eyes]
    if name == "guestrin2006" and "E5" in eyes and "published" in protocols:
        out += [(v, ("published",)) for v in VARIANTS if v not in eyes]
    return out


def _analytic(
    name: str, models: Sequence[tuple[str, tuple[str, ...]]], workers: int, progress: Progress | None
) -> list[Any]:
    return _collected(partial(_job, name), list(models), [eye for eye, _ in models], workers, progress)


def _collected(
    job: Callable[[Any], Any], items: list[Any], names: Sequence[str], workers: int, progress: Progress | None
) -> list[Any]:
    """The results of a job for each item, in order."""
    out = []
    with _mapper(min(workers, len(items))) as mapped:
        for k, part in enumerate(mapped(job, items)):
            out.append(part)
            if progress is not None:
                progress(k + 1, len(items), names[k])
    return out


def _job(name: str, model: tuple[str, tuple[str, ...]]) -> GuestrinPart | BlignautPart:
    eye, protocols = model
    return (guestrin_part if name == "guestrin2006" else blignaut_part)(eye, protocols, Observing())


@contextmanager
def _mapper(workers: int) -> Iterator[Callable[..., Any]]:
    """`map`, or that of a pool of processes; those start afresh, for a fork would take the parent's threads along."""
    if workers <= 1:
        yield map
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield pool.map


def _guestrin(
    parts: Sequence[GuestrinPart], protocols: Sequence[str]
) -> tuple[list[Row], list[Finding], dict[str, Any], Page]:
    rows = [row for part in parts for row in part.rows]
    found, tests = [], []
    keys = list(dict.fromkeys(key for part in parts for key in part.means))
    for key in keys:
        means = {p.eye_model: p.means[key] for p in parts if key in p.means}
        errors = {p.eye_model: p.h1_errors[key] for p in parts if key in p.h1_errors}
        found += findings.guestrin(means, errors, *key)
        tests += [{"protocol": key[0], "observer": key[1], **t} for t in findings.t_tests(means)]
    misprints = {p.eye_model: p.misprints for p in parts if p.misprints}
    steps = [asdict(step) for part in parts for step in part.waterfall]
    faults = errata.guestrin(misprints)
    apart = _observers_apart(parts)
    more = {
        "optimiser": guestrin.optimiser_settings(protocols),
        "calibrations": [c for part in parts for c in part.calibrations],
        "t_tests": tests,
        "departures": [asdict(d) for d in guestrin.DEPARTURES],
        "errata": [asdict(e) for e in faults],
        "misprints": misprints,
        "waterfall": steps,
        **_as_mappings(apart),
    }
    return rows, found, more, pages.guestrin_page(parts, found, tests, faults, apart)


def _blignaut(
    parts: Sequence[BlignautPart], protocols: Sequence[str]
) -> tuple[list[Row], list[Finding], dict[str, Any], Page]:
    rows = [row for part in parts for row in part.rows]
    found: list[Finding] = []
    keys = list(dict.fromkeys(key for part in parts for key in part.outcomes))
    for protocol, observer in keys:
        here = {p.eye_model: p for p in parts if (protocol, observer) in p.outcomes}
        found += findings.blignaut({m: p.outcomes[protocol, observer] for m, p in here.items()}, protocol, observer)
        found += clouds.findings({m: p.clouds[protocol, observer] for m, p in here.items()}, protocol, observer)
        if protocol == "corrected":
            centred = {m: p.centred[protocol, observer] for m, p in here.items()}
            found += findings.blignaut(centred, "corrected, centred vector", observer)
    faults = errata.blignaut()
    apart = _observers_apart(parts)
    more = {
        "departures": [asdict(d) for d in blignaut.DEPARTURES],
        "errata": [asdict(e) for e in faults],
        "waterfall": [asdict(step) for part in parts for step in part.waterfall],
        **_as_mappings(apart),
    }
    return rows, found, more, pages.blignaut_page(parts, found, faults, apart)


def _observers(parts: Sequence[HeadMountedPart]) -> tuple[list[Row], list[Finding], dict[str, Any], Page]:
    apart = _observers_apart(parts)
    found = head_mounted.findings(*apart)
    more = {**head_mounted.more(), **_as_mappings(apart)}
    return [row for part in parts for row in part.rows], found, more, head_mounted_page.page(parts, found, apart)


def _observers_apart(parts: Sequence[GuestrinPart | BlignautPart | HeadMountedPart]) -> Apart:
    """How the observers differ on the frames that both have seen."""
    features: list[observers_compared.FeatureDifference] = []
    gaze: list[observers_compared.GazeDifference] = []
    seen = {(p.eye_model, *key): (p, key) for p in parts for key in p.seen}
    for (model, protocol, observer), (other, key) in seen.items():
        analytic = seen.get((model, protocol, "analytic"))
        if observer == "analytic" or analytic is None:
            continue
        part, own = analytic
        rig, truth = part.seen[own]
        features += observers_compared.features(truth, other.seen[key][1], rig, protocol, observer, model)
        mine, theirs = part.errors[own], other.errors[key]
        for name in mine:
            if name in theirs:
                difference = observers_compared.gaze(mine[name], theirs[name], protocol, observer, model, name)
                gaze += [difference] if difference else []
    return features, gaze


def _as_mappings(apart: Apart) -> dict[str, Any]:
    features, gaze = apart
    if not features:
        return {}
    return {"observers": {"features": [f.to_mapping() for f in features], "gaze": [g.to_mapping() for g in gaze]}}


def _waterfall_csv(steps: Sequence[dict[str, Any]]) -> str:
    lines = ["eye_model,departure,measure,cumulative_deg,alone_deg"]
    for step in steps:
        for measure, value in step["errors"].items():
            cells = [value, step["alone"][measure]]
            lines.append(
                f"{step['eye_model']},{step['departure']},{measure},"
                + ",".join("" if c is None else repr(c) for c in cells)
            )
    return "\n".join(lines) + "\n"
