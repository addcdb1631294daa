"""Commands that observe: features, extract, compare."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from ..base.errors import InputError, InputWarning
from ..base.processes import usable_cpus
from ..base.status import Status
from ..imaging.tracker import Tracker
from ..scene.observation import EYES, MAX_BOUNDARY_POINTS, Observations
from .app import app
from .options import AtLeastOne, EyeModel, Result, SceneName, Strict
from .output import Heed, emit, progress

if TYPE_CHECKING:
    from ..extraction.region import SearchRegion
    from ..extraction.settings import ExtractionSettings
    from ..scene import Scene


@app.command(name="features")
def features(
    scene: SceneName,
    /,
    *,
    eye: EyeModel = None,
    points: int = 30,
    purkinje: Annotated[tuple[int, ...] | None, Parameter(consume_multiple=True)] = None,
    tracker: Annotated[Tracker, Parameter(name="*")] = Tracker(),
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    format: Literal["csv", "asc", "bids"] = "csv",
    screen_px: tuple[int, int] = (1920, 1080),
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Compute the apparent pupil and the glints of a scene by ray optics.

    This needs no renderer.

    Args:
        points: Number of boundary points of the pupil.
        purkinje: Add these Purkinje images (1 to 4) to the records, and the deviation of the pupil from an ellipse to
            the JSON.
        output: With --rate: the file of the trace, or the folder of bids.
        format: With --rate: a table (csv), EyeLink's text form (asc), or a folder of BIDS eye tracking (bids).
        screen_px: With --format asc or bids: width and height of the screen in pixels.
    """
    # `observers` would load OpenCV, which is not needed here.
    from ..analytic.observer import AnalyticObserver
    from ..imaging.gazeseries import check_screen, screen_warnings
    from ..imaging.labels import space_labels

    if points < 6:
        raise InputError(f"must be >= 6, not {points}", source="--points")
    if points > MAX_BOUNDARY_POINTS:
        raise InputError(f"must be <= {MAX_BOUNDARY_POINTS}", source="--points")
    if purkinje == ():
        raise InputError("needs numbers of Purkinje images, 1 to 4", source="--purkinje")
    tracker.refuse_unused(format)
    if (output is None) != (tracker.rate == 0.0):
        missing = ("--output", "with --rate") if output is None else ("--rate", "with --output")
        raise InputError(f"is needed {missing[1]}", source=missing[0])
    heed = Heed(strict)
    loaded = heed.scene(scene, eye=eye)
    if output is not None:
        check_screen(screen_px)
        if format != "csv" and loaded.rig.screen is not None:
            heed(screen_warnings(loaded.rig.screen, screen_px))
        trace = _sampled(loaded, tracker, output, format, screen_px)
        emit(trace, f"{output}: {trace['rows']} samples, {tracker.rate:g} per second", json, heed)
        return 0
    frames = loaded.frames()
    observed, seen = AnalyticObserver(points).observe_in_detail(frames, purkinje=purkinje or ())
    data: dict[str, Any] = {
        "schema": "eyerender/features/1",
        "rig": loaded.rig.to_mapping(),
        "records": list(observed.records()),
        "space": space_labels(frames, observed) if json is not None else [],
    }
    if purkinje:
        data["non_ellipticity_px"] = [float(v) if np.isfinite(v) else None for v in seen.ellipse_residual_px]
    emit(data, _feature_table(observed), json, heed)
    return 0


def _sampled(scene: Scene, tracker: Tracker, output: Path, form: str, screen_px: tuple[int, int]) -> dict[str, Any]:
    """Write the trace of a sequence, and beside a table its schema, which is returned."""
    from ..base.storage.files import csv_text, refuse_special, write_json, write_text
    from ..folders.outfolder import refuse_non_empty, staged
    from ..imaging.asc import asc_text
    from ..imaging.bids import write_trace
    from ..imaging.trace import sample_sequence

    if form == "bids":
        refuse_non_empty(output, False)
    else:
        refuse_special(output)
    trace = sample_sequence(scene, tracker)
    if form == "bids":
        with staged(output) as folder:
            write_trace(folder, trace, screen_px)
    elif form == "asc":
        write_text(output, asc_text(trace, screen_px))
    else:
        write_text(output, csv_text(trace.header(), trace.rows()))
        write_json(output.with_name(output.name + ".json"), trace.to_mapping())
    return trace.to_mapping()


def _rig_scene(name: str, heed: Heed) -> Scene:
    """Load a scene, or put both eyes of an average person before the rig of a rig file."""
    from ..gaze.records import RigFile, is_rig_file
    from ..scene import Scene
    from ..scene.spec import SceneSpec

    if not is_rig_file(name):
        return heed.scene(name)
    rig = RigFile.load(name).resolved(Path(name).parent).to_mapping()
    del rig["format"]
    spec = {"format": SceneSpec.FORMAT, "name": "rig", "eye": {"model": "adult"}, "rig": rig}
    return Scene.of(SceneSpec.from_mapping({**spec, "targets": {"world_mm": [[600, 0, 0]]}}, source=name))


@app.command(name="extract")
def extract(
    *images: Path,
    scene: str | None = None,
    camera: int | None = None,
    gamma: float | None = None,
    method: Literal["fast", "refined", "centroid"] = "refined",
    reflections: Literal["filled", "excluded"] | None = None,
    eyes: int = 1,
    arrangement: Literal["side-by-side", "stacked"] | None = None,
    order: Literal["right-left", "left-right"] | None = None,
    polarity: Literal["auto", "dark", "bright"] = "auto",
    radius_px: tuple[float, float] | None = None,
    roi: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    min_confidence: float | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    overlay: Path | None = None,
    processes: AtLeastOne = None,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Extract the pupil ellipse and the glints from images or a video.

    An image without a detected pupil is a result with a reason, not an error. In a video, the search starts where the
    pupil was in the previous frame. Files of a folder that are not images are skipped, and the reasons are printed.

    Args:
        images: Greyscale images, one folder of images, or one video.
        scene: A scene with the rig, or a rig file; glints are assigned to its lights and listed in their order.
        camera: Number of the scene's camera that took the images (default: 0).
        gamma: Encoding gamma of the pixel values (default: 1, linear; 8-bit videos are mostly encoded with 2.2).
        method: fast: edges and an algebraic fit; refined: also a maximum-likelihood fit; centroid: area (pi a b) and
            centre of mass of the thresholded pupil, as many laboratory trackers report.
        reflections: With --method centroid: whether reflections that the pupil encloses belong to it (default: filled).
        eyes: 2 for images of both eyes. The eye on the image's left is then called the right eye.
        arrangement: With --eyes 2: each image holds the pictures of two cameras, beside or above each other. The left
            or upper one shows the subject's right eye.
        order: With --eyes 2: the subject's eyes from the left, or from above (default: right-left).
        polarity: Whether the pupil is darker or brighter than the iris.
        radius_px: Smallest and largest semi-axis of the pupil.
        roi: Part of the image to search, in pixels: X Y WIDTH HEIGHT, or a mask picture that is not black there. With
            --eyes 2, first the one of the eye on the image's left, then the other.
        min_confidence: Least probability that a pupil is right; others are missing.
        output: File for the records, one per line (JSON lines), or a table (.csv).
        overlay: Draw the results over the images: a folder for images (PNG), or a file for a video (.mp4, .avi or
            .mkv).
        processes: Number of images processed at the same time (default: one per processor).
    """
    from ..base.storage.files import make_folder, refuse_special, write_text
    from ..folders.video import VideoReader, is_video
    from ..gaze.records import is_table
    from ..gaze.table import features_csv
    from ..imaging.imageobserver import ImageObserver, files_of, lights_of
    from ..imaging.videoobserver import VideoOutput, observe_video

    _check_extract(images, gamma, eyes)
    heed = Heed(strict)
    loaded = None if scene is None else _rig_scene(scene, heed)
    special = {"arrangement": arrangement, "order": order, "reflections": reflections}
    for name, value in special.items():
        needed = "--method centroid" if name == "reflections" else "--eyes 2"
        if value is not None and needed not in (f"--method {method}", f"--eyes {eyes}"):
            raise InputError(f"belongs to {needed}", source=f"--{name}")
    settings = _settings(radius_px, min_confidence, method=method, polarity=polarity, **special)
    rois = _rois(roi, eyes)
    heed(_exchanged(rois, stacked=arrangement == "stacked"))
    observer = ImageObserver(gamma=1.0 if gamma is None else gamma, settings=settings, camera=camera, rois=rois)
    if output is not None:
        refuse_special(output)
        if output.suffix.lower() in (".xlsx", ".xls", ".ods"):
            raise InputError("no workbook is written; name the file .csv, which spreadsheets read", source=str(output))
    if is_video(images[0]):
        if len(images) > 1:
            raise InputError("give one video at a time", source=str(images[1]))
        video = VideoReader(images[0])  # which refuses what is no video, before any warning
        heed(_gamma_warnings(gamma, images[0]))
        with progress("extracting") as steps:
            files = VideoOutput(output, overlay)
            result = observe_video(video, observer, files, scene=loaded, eyes=eyes, progress=steps, warn=heed)
        emit(result.to_mapping(), result.to_text(), json, heed)
        return 0
    if overlay is not None:
        make_folder(overlay)
    with progress("extracting") as steps:
        observed = observer.observe_files(
            images, scene=loaded, progress=steps, eyes=eyes, pictures=overlay, warn=heed,
            processes=processes or usable_cpus(),
        )  # fmt: skip
    records = list(observed.records())
    if output is not None:
        lines = (json_module.dumps(one, allow_nan=False) + "\n" for one in records)
        table = is_table(output)
        write_text(output, features_csv(observed, lights_of(loaded)) if table else "".join(lines), sync=False)
    rig = None if loaded is None else loaded.rig.to_mapping()
    data = {"schema": "eyerender/features/1", "rig": rig, "records": records}
    names = None
    if observed.index.camera.max() < 0:  # another program rendered the folder
        paths = files_of(images)
        names = [str(paths[frame]) for frame in observed.index.frame]
    emit(data, _feature_table(observed, names), json, heed)
    return 0


def _settings(
    radius_px: tuple[float, float] | None, min_confidence: float | None, **given: str | None
) -> ExtractionSettings:
    """Return the settings of an extractor from the options of the command."""
    from ..extraction.settings import ExtractionSettings

    low, high = radius_px or (None, None)
    numbers = {"radius_min_px": low, "radius_max_px": high, "min_confidence": min_confidence}
    try:
        return ExtractionSettings.from_mapping({k: v for k, v in (given | numbers).items() if v is not None})
    except InputError as error:
        option = "--min-confidence" if error.path == "min_confidence" else "--radius-px"
        raise InputError(error.reason, source=option) from None


def _rois(values: Sequence[str], eyes: int) -> tuple[SearchRegion, ...]:
    """Return the regions of each eye from four numbers or a mask picture each; none without values."""
    from ..folders.imagefile import read_any_image

    if not values:
        return ()
    if len(values) == eyes:
        return tuple(read_any_image(one)[0] for one in values)
    numbers = [int(one) for one in values if one.isdecimal()]
    if len(numbers) != len(values) or len(numbers) != 4 * eyes:
        needed = "X Y WIDTH HEIGHT or a mask picture" + (" for each of two eyes" if eyes == 2 else "")
        raise InputError(f"must be {needed}, not {' '.join(values)}", source="--roi")
    return tuple((x, y, w, h) for x, y, w, h in zip(*(numbers[k::4] for k in range(4)), strict=True))


def _exchanged(rois: Sequence[SearchRegion], *, stacked: bool) -> list[InputWarning]:
    """Warn of the regions of two eyes in the wrong order."""
    if len(rois) != 2:
        return []
    axis = 1 if stacked else 0

    def middle(one: SearchRegion) -> float:
        if not isinstance(one, np.ndarray):
            return float(one[axis] + one[axis + 2] / 2)
        places = np.nonzero(one)[1 - axis]
        return float(places.mean()) if len(places) else np.nan

    middles = [middle(one) for one in rois]
    if not middles[0] > middles[1]:
        return []
    where, first = ("below", "upper") if stacked else ("right of", "left")
    reason = (
        f"the first region lies {where} the second; the {first} one comes first, or the eyes have each other's names"
    )
    return [InputWarning(code="roi", reason=reason, source="--roi")]


def _check_extract(images: Sequence[Path], gamma: float | None, eyes: int) -> None:
    if not images:
        raise InputError("give at least one image", source="extract")
    if gamma is not None and not (np.isfinite(gamma) and 0.1 <= gamma <= 10):
        raise InputError("must be between 0.1 and 10", source="--gamma")
    if eyes not in (1, 2):
        raise InputError("must be 1 or 2", source="--eyes")


def _gamma_warnings(gamma: float | None, video: Path) -> list[InputWarning]:
    """Warn of a video whose encoding nobody has stated."""
    reason = "has 8 bits, taken as linear; give --gamma 2.2 if the camera or its codec encodes them (most do)"
    return [] if gamma is not None else [InputWarning(code="gamma", reason=reason, source=str(video))]


@app.command(name="compare")
def compare(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *,
    estimator: str = "regression",
    function: str = "R3",
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Compare the features extracted from a folder's images with the exact ones.

    The differences are given in pixels and in degrees of gaze.

    Args:
        folder: A folder written by render, quickstart or generate.
        estimator: The gaze estimator: a name as in `gaze fit`, or module:Class, a class of your own.
        function: regression: the function, R1 to R12.
    """
    from ..apps.quickstart import compare_folder
    from ..gaze.determined import undetermined_to
    from ..gaze.store import choose_estimator

    chosen = choose_estimator(estimator, function=function)
    name = f"regression {function}" if estimator == "regression" else estimator
    heed = Heed(strict)
    with progress("extracting") as steps, undetermined_to(heed, str(folder)):
        result = compare_folder(folder, estimator=chosen, name=name, progress=steps)
    emit(result.to_mapping(), result.to_text(), json, heed)
    return 0


def _feature_table(observed: Observations, names: list[str] | None = None) -> str:
    """Write one line per observation."""
    index, pupil, glints = observed.index, observed.pupil, observed.glints
    lines = [f"{'frame':>5} {'eye':<5} {'pupil centre px':>21} {'semi-axes px':>17} {'angle deg':>9}  glints px"]
    for i in range(len(observed)):
        eye = EYES[index.eye[i]] if index.eye[i] >= 0 else "-"
        if pupil.ok[i]:
            (x, y), (a, b) = pupil.centre_px[i], pupil.semi_axes_px[i]
            text = f"{x:>10.4f} {y:>10.4f} {a:>8.4f} {b:>8.4f} {np.degrees(pupil.angle_rad[i]):>9.3f}"
            text += "" if pupil.in_image[i] else " (off the sensor)"
        else:
            text = f"{f'{Status(pupil.status[i]).label}: {pupil.reason[i]}':<49}"
        spots = []
        for j in range(glints.status.shape[1]):
            light = "?" if glints.light[i, j] < 0 else str(glints.light[i, j])
            if glints.ok[i, j]:
                spots.append(f"{light}: ({glints.xy_px[i, j, 0]:.4f}, {glints.xy_px[i, j, 1]:.4f})")
            elif glints.status[i, j] != Status.NONE:
                spots.append(f"{light}: missing ({glints.reason[i, j]})")
        name = f"  {names[i]}" if names else ""
        lines.append(f"{index.frame[i]:>5} {eye:<5} {text}  {'  '.join(spots)}{name}")
    return "\n".join(lines)
