"""Run a study, test its findings, and write the results and the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ...base.errors import EyerenderError, InputError
from ...base.processes import mapper, usable_cpus
from ...base.progress import Progress, Say, notify
from ...base.storage.files import csv_text, read_json, write_json, write_text
from ...base.storage.lock import writer_lock
from ...eye.catalogue import load_eye
from ...folders.outfolder import clear, refuse_non_empty
from ...report.page import write_page
from ...scene import Scene
from . import blignaut, guestrin, head_mounted, summarise
from .conditions import DRAWN_PEOPLE, conditions_part, people_part
from .head_mounted import head_mounted_part
from .images import make_images
from .literature import MODELS, VARIANTS
from .observing import ObserverKind, Observing
from .options import StudyOptions
from .replicate import blignaut_part, facing, guestrin_part, scenes_of
from .results import write_results

STUDIES = ("guestrin2006", "blignaut2014", "observers", "conditions")
RUN_SCHEMA = "eyerender/study/1"
MARKER, REPORT, IMAGES = "study.json", "report.html", "images"
_SUMMARISE: dict[str, Callable[..., summarise.Results]] = {
    "guestrin2006": summarise.guestrin_results,
    "blignaut2014": summarise.blignaut_results,
    "observers": summarise.observers_results,
    "conditions": summarise.conditions_results,
}


def run_study(
    name: str,
    folder: str | Path,
    options: StudyOptions = StudyOptions(workers=1),
    *,
    eyes: Sequence[str] = MODELS,
    progress: Progress | None = None,
    say: Say | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Run a study; write summary.json, findings.json, both as CSV, and report.html into a folder.

    A study may be run again in its own folder. Its images are a dataset in `images/`: an interrupted run continues, and
    a finished one is reused.

    Args:
        name: guestrin2006, blignaut2014, observers (both observers on the head-mounted rig), or conditions (beyond the
            paper; analytic).
        folder: the folder for the results.
        options: protocol, observer, workers and the like.
        eyes: eye models (catalogue names or files). With E5 and `published`, its two published variants are included.
        progress: called with (done, total, note).
        say: called with a message for each problem that does not end the run.
        changes: fields of `StudyOptions` by name, instead of those of `options`.

    Returns:
        The summary that was written.

    Raises:
        InputError: the study, an eye or an option is unknown, or the folder holds something else.
        BackendError: no backend can render the images.
    """
    if name not in STUDIES:
        raise InputError(f"{name!r} is not a study; choose from {', '.join(STUDIES)}")
    if not eyes or len(set(eyes)) != len(eyes):
        raise InputError("name each eye once", source="--eyes")
    for eye in eyes:
        load_eye(eye)
    options = replace(options, **changes)
    observer = options.observer or ("both" if name == "observers" else "analytic")
    if name == "conditions" and observer != "analytic":
        raise InputError("the study 'conditions' supports the analytic observer only", source="--observer")
    if name == "observers" and observer != "both":
        raise InputError("the study 'observers' compares both observers", source="--observer")
    settings: dict[str, Any] = {"study": name, "protocol": options.protocol, "observer": observer, "eyes": list(eyes)}
    if observer != "analytic":
        settings |= {"spp": options.spp, "sensor_noise": options.noise, "noise_seeds": options.noise_seeds}
    settings |= _exposure(options.auto_exposure, observer)
    folder = Path(folder)
    protocols = ("published", "corrected") if options.protocol == "both" else (options.protocol,)
    kinds = _kinds(observer, options.noise)
    with _claimed(folder, settings, options.overwrite):
        start = time.monotonic()
        images = None
        if any(kind != "analytic" for kind in kinds):
            scenes = _image_scenes(name, eyes, protocols, kinds, options.spp)
            images = make_images(name, scenes, folder / IMAGES, options, _noted(progress), say)
        # The noise term, which needs images with and without noise, is the mean of several exposures.
        seeds = {"image-noiseless": options.noise_seeds} if "image" in kinds else {}
        observers = [Observing(k, None if k == "analytic" else images, seeds.get(k, 0)) for k in kinds]
        # One job compares all observers, or has one of them.
        together_or_alone = [tuple(observers)] if name == "observers" else [(one,) for one in observers]
        jobs = [
            (observings, eye, told)
            for observings in together_or_alone
            for eye, told in _models(name, eyes, protocols, observings)
        ]
        count = options.workers or usable_cpus()
        notes = [f"{eye}, {' and '.join(o.kind for o in observings)}" for observings, eye, _ in jobs]
        parts = _collected(partial(_job, name), jobs, notes, count, progress)
        rows, found, more, page = _SUMMARISE[name](parts, protocols)
        more = {"settings": settings, "seconds": round(time.monotonic() - start, 2), **more}
        summary = write_results(folder, name, rows, found, more)
        if "waterfall" in more:
            write_text(folder / "waterfall.csv", _waterfall_csv(more["waterfall"]))
        write_page(folder / REPORT, page)
        return summary


def _exposure(level: float | None, observer: str) -> dict[str, float]:
    """Check the setting of the automatic exposure, if there is one."""
    if level is None:
        return {}
    if observer == "analytic":
        raise InputError("the analytic observer takes no images", source="--auto-exposure")
    if not 0.01 <= level <= 2:
        raise InputError("must be 0.01 to 2", source="--auto-exposure")
    return {"auto_exposure": level}


def _kinds(observer: str, noise: str) -> list[ObserverKind]:
    """Return the observers of a run."""
    kinds: list[ObserverKind] = []
    if observer != "image":
        kinds.append("analytic")
    if observer != "analytic":
        kinds += [kind for kind, without in (("image", "off"), ("image-noiseless", "on")) if noise != without]  # type: ignore[misc]
    return kinds


def _noted(progress: Progress | None) -> Progress | None:
    """Adapt the progress notes of a dataset run to a study."""
    if progress is None:
        return None
    return lambda done, total, note: progress(done, total, note.replace("samples", "samples of images", 1))


def _image_scenes(
    name: str, eyes: Sequence[str], protocols: Sequence[str], kinds: Sequence[ObserverKind], spp: int | None
) -> list[Scene]:
    """Return the scenes of all images that a study needs."""
    if name == "observers":
        scenes, turned = [head_mounted.scene(eye) for eye in eyes], False
    else:
        module = guestrin if name == "guestrin2006" else blignaut
        scenes, turned = scenes_of(module, eyes, protocols), facing(module)
    shots = [s for scene in scenes for k in kinds for s in Observing(k).shots(scene, facing=turned, spp=spp)]
    return [shot.scene for shot in shots]


def _models(
    name: str, eyes: Sequence[str], protocols: Sequence[str], observings: Sequence[Observing]
) -> list[tuple[str, tuple[str, ...]]]:
    """Return eye models with their protocols; the published variants of E5 have their own names."""
    out = [(eye, tuple(protocols)) for eye in eyes]
    if name == "guestrin2006" and observings[0].kind == "analytic" and "E5" in eyes and "published" in protocols:
        out += [(v, ("published",)) for v in VARIANTS if v not in eyes]
    if name == "conditions":
        out.append((DRAWN_PEOPLE, tuple(protocols)))
    return out


def _job(name: str, job: tuple[tuple[Observing, ...], str, tuple[str, ...]]) -> Any:
    observings, eye, protocols = job
    if name == "conditions":
        return people_part() if eye == DRAWN_PEOPLE else conditions_part(eye)
    if name == "observers":
        return head_mounted_part(eye, observings)
    return (guestrin_part if name == "guestrin2006" else blignaut_part)(eye, protocols, observings[0])


def _collected(
    job: Callable[[Any], Any], items: list[Any], names: Sequence[str], workers: int, progress: Progress | None
) -> list[Any]:
    """Run a job on each item and collect the results in order."""
    out = []
    notify(progress, 0, len(items), "eye models")
    with mapper(min(workers, len(items))) as mapped:
        for k, part in enumerate(mapped(job, items)):
            out.append(part)
            notify(progress, k + 1, len(items), f"eye models, {names[k]}")
    return out


@contextmanager
def _claimed(folder: Path, settings: dict[str, Any], overwrite: bool) -> Iterator[None]:
    """Mark a folder as this study's during the block; a run that fails before it wrote anything leaves nothing behind.

    Raises:
        InputError: the folder holds something else, or another writer uses it.
    """
    try:
        found = read_json(folder / MARKER, follow=False)
        same = found.get("schema") == RUN_SCHEMA and found.get("settings", {}).get("study") == settings["study"]
    except (InputError, AttributeError):
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
        with writer_lock(folder):
            if not same and overwrite:
                clear(folder)
            write_json(folder / MARKER, {"schema": RUN_SCHEMA, "settings": settings})
            yield
        done = True
    finally:
        if not done and not same:
            images = folder / IMAGES
            if images.is_dir() and not any(images.iterdir()):
                images.rmdir()
            if [p.name for p in folder.iterdir()] == [MARKER]:
                (folder / MARKER).unlink()
            if created and not any(folder.iterdir()):
                folder.rmdir()


def _waterfall_csv(steps: Sequence[dict[str, Any]]) -> str:
    rows = [
        (step["eye_model"], step["departure"], measure, value, step["alone"][measure])
        for step in steps
        for measure, value in step["errors"].items()
    ]
    return csv_text(("eye_model", "departure", "measure", "cumulative_deg", "alone_deg"), rows)
