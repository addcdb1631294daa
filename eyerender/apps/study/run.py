"""Run a study, test its findings, and write the results and the report."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from ...base.errors import EyerenderError, InputError
from ...base.progress import Progress, Say
from ...base.references import is_reference, load_reference
from ...base.storage.files import read_json, write_json
from ...base.storage.lock import writer_lock
from ...eye.catalogue import load_eye
from ...folders.outfolder import clear, refuse_non_empty
from ...report.page import write_page
from ...scene.people import Population
from .images import make_images
from .observing import ObserverKind, Observing
from .options import StudyOptions
from .results import write_results
from .study import Study, StudyJob, StudyPlan

STUDIES: Final = MappingProxyType(
    {
        "guestrin2006": "guestrin_study:GuestrinStudy",
        "blignaut2014": "blignaut_study:BlignautStudy",
        "observers": "head_mounted:ObserversStudy",
        "conditions": "conditions_study:ConditionsStudy",
        "rigs": "rigs:RigsStudy",
        "glasses": "glasses_study:GlassesStudy",
        "pupil-size": "pupil_size:PupilSizeStudy",
        "calibration": "calibration_study:CalibrationStudy",
        "stereo": "stereo:StereoStudy",
        "head-movement": "head_movement:HeadMovementStudy",
        "appearance": "appearance:AppearanceStudy",
    }
)
"""Name of a study -> its class in this package."""
RUN_SCHEMA = "eyerender/study/1"
MARKER, REPORT, IMAGES = "study.json", "report.html", "images"
PEOPLE_SEED = 0
IMAGE_OBSERVERS = ("image", "both")


def run_study(
    study: str | type[Study],
    folder: str | Path,
    options: StudyOptions = StudyOptions(workers=1),
    *,
    eyes: Sequence[str] | None = None,
    progress: Progress | None = None,
    say: Say | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Run a study; write summary.json, findings.json, both as CSV, and report.html into a folder.

    A study may be run again in its own folder. Its images are a dataset in `images/`: an interrupted run continues, and
    a finished one is reused.

    >>> er.apps.run_study("conditions", "out/conditions", eyes=["E2"])  # doctest: +SKIP

    Args:
        study: the name of one of the package, as in `eyerender study --help`; or your own: a subclass of `Study`, or
            its name as `module:Class`.
        folder: the folder for the results.
        options: protocol, observer, workers and the like.
        eyes: eye models (catalogue names or files; default: those of the study, or none if people are asked for).
        progress: called with (done, total, note).
        say: called with a message for each problem that does not end the run.
        changes: fields of `StudyOptions` by name, instead of those of `options`.

    Returns:
        The summary that was written.

    Raises:
        InputError: the study, an eye or an option is unknown, or the folder holds something else.
        BackendError: no backend can render the images.
    """
    name = study if isinstance(study, str) else f"{study.__module__}:{study.__qualname__}"
    chosen = load_study(name) if isinstance(study, str) else study()
    folder = Path(folder)
    plan = replace(planned(chosen, name, replace(options, **changes), eyes), folder=folder / IMAGES)
    settings = _settings(name, plan)
    with _claimed(folder, settings, plan.options.overwrite):
        start = time.monotonic()
        with mistakes_of(name) if isinstance(study, str) else nullcontext():
            plan = _with_images(chosen, name, plan, progress, say)
            report = chosen.report(chosen.parts(plan, progress), plan.protocols)
        seconds = round(time.monotonic() - start, 2)
        summary = write_results(folder, name, {"settings": settings, "seconds": seconds}, report)
        write_page(folder / REPORT, report.page)
        return summary


def load_study(name: str) -> Study:
    """Create a study from its name, or a user's own from `module:Class`.

    Raises:
        InputError: there is no such study.
    """
    if name not in STUDIES and not is_reference(name):
        known = ", ".join(STUDIES)
        raise InputError(f"{name!r} is not a study; choose from {known}, or give your own as module:Class")
    if name not in STUDIES and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # workers start in the folder in which Python was started
    kind = load_reference(f"{__package__}.{STUDIES[name]}" if name in STUDIES else name, source=name)
    if not (isinstance(kind, type) and issubclass(kind, Study)):
        raise InputError("is not a subclass of eyerender.apps.Study", source=name)
    with mistakes_of(name):
        return kind()


@contextmanager
def mistakes_of(name: str) -> Iterator[None]:
    """Turn what a user's own study raises into one line; errors of this package's studies are left alone.

    Raises:
        InputError: the block raised another exception than an error of this package.
    """
    try:
        yield
    except EyerenderError:
        raise
    except Exception as error:
        if name in STUDIES:
            raise
        raise InputError(f"{type(error).__name__}: {error}", source=name) from error


def planned(study: Study, name: str, options: StudyOptions, eyes: Sequence[str] | None) -> StudyPlan:
    """Check the options of a run; return its plan, without images.

    Raises:
        InputError: an eye model or an option does not suit the study.
    """
    count = _people_asked(study, name, options)
    if eyes is None:
        eyes = () if count and not study.people else study.eyes
    elif not study.eyes:
        raise InputError(f"has no meaning for the study {name!r}, whose eyes are those of people", source="--eyes")
    elif not eyes or len(set(eyes)) != len(eyes):
        raise InputError("name each eye once", source="--eyes")
    for eye in eyes:
        load_eye(eye)
    observer = options.observer or study.observers[0]
    if observer not in study.observers:
        known = " or ".join(map(repr, study.observers))
        raise InputError(f"the study {name!r} needs {known}, not {observer!r}", source="--observer")
    if options.image_people is not None and not (count and observer in IMAGE_OBSERVERS):
        raise InputError("needs people and an observer of images", source="--image-people")
    if (options.image_people or 0) > count:
        raise InputError(f"must be at most the number of people, {count}", source="--image-people")
    preset = Population(options.population or study.population or "adults").preset
    protocols = (options.protocol,) if options.protocol in study.protocols else tuple(study.protocols)
    return StudyPlan(
        options=options,
        eyes=tuple(eyes),
        people=tuple({"preset": preset, "seed": PEOPLE_SEED, "subject": k} for k in range(count)),
        protocols=protocols,
        observer=observer,
        observings=tuple(
            Observing(kind=kind, spp=options.spp, backend=options.backend, threads=options.threads)
            for kind in _kinds(observer, options.noise)
        ),
    )


def _people_asked(study: Study, name: str, options: StudyOptions) -> int:
    """Return the number of people of a run."""
    asked = options.people is not None or options.population is not None
    if asked and study.population is None:
        raise InputError(f"the study {name!r} draws no people", source="--people")
    count = study.people if options.people is None else options.people
    if asked and not count:
        raise InputError("give the number of people, too: --people N", source="--population")
    return count


def _settings(name: str, plan: StudyPlan) -> dict[str, Any]:
    """Return the settings that the study's files state."""
    options = plan.options
    settings: dict[str, Any] = {
        "study": name,
        "protocol": options.protocol,
        "observer": plan.observer,
        "eyes": list(plan.eyes),
    }
    if plan.people:
        settings |= {"population": plan.people[0]["preset"], "people": len(plan.people)}
        settings |= {} if options.image_people is None else {"image_people": options.image_people}
    if plan.observer in IMAGE_OBSERVERS:
        settings |= {"spp": options.spp, "sensor_noise": options.noise, "noise_seeds": options.noise_seeds}
    return settings | _exposure(options.auto_exposure, plan.observer)


def _with_images(study: Study, name: str, plan: StudyPlan, progress: Progress | None, say: Say | None) -> StudyPlan:
    """Make the images that a plan needs, and give them to its observers."""
    kinds = [one.kind for one in plan.observings]
    if not {"image", "image-noiseless"} & set(kinds) or not plan.eyes:
        return plan
    scenes = []
    for eye in plan.eyes:
        own = [s for p in plan.protocols for s in study.scenes(StudyJob(who=eye), p).values()]
        scenes += [
            shot.scene for scene in own for one in plan.observings
            for shot in one.shots(scene, facing=study.facing, spp=plan.options.spp)
        ]  # fmt: skip
    images = make_images(name, scenes, plan.folder, plan.options, _noted(progress), say)
    # The noise term, which needs images with and without noise, is the mean of several exposures.
    seeds = {"image-noiseless": plan.options.noise_seeds} if "image" in kinds else {}
    observings = tuple(
        one if one.kind == "analytic" else replace(one, images=images, noise_seeds=seeds.get(one.kind, 0))
        for one in plan.observings
    )
    return replace(plan, observings=observings)


def _exposure(level: float | None, observer: str) -> dict[str, float]:
    """Check the setting of the automatic exposure, if there is one."""
    if level is None:
        return {}
    if observer not in IMAGE_OBSERVERS:
        raise InputError(f"the {observer} observer takes no images", source="--auto-exposure")
    if not 0.01 <= level <= 2:
        raise InputError("must be 0.01 to 2", source="--auto-exposure")
    return {"auto_exposure": level}


def _kinds(observer: str, noise: str) -> list[ObserverKind]:
    """Return the observers of a run."""
    kinds: list[ObserverKind] = []
    if observer in ("analytic", "both"):
        kinds.append("analytic")
    if observer in IMAGE_OBSERVERS:
        kinds += [kind for kind, without in (("image", "off"), ("image-noiseless", "on")) if noise != without]  # type: ignore[misc]
    return kinds


def _noted(progress: Progress | None) -> Progress | None:
    """Adapt the progress notes of a dataset run to a study."""
    if progress is None:
        return None
    return lambda done, total, note: progress(done, total, note.replace("samples", "samples of images", 1))


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
