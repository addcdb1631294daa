"""Commands of gaze estimation: gaze fit and gaze predict on a user's own records, and budget."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from ..base.errors import InputError, InputWarning
from .app import app
from .options import AtLeastOne, Backend, EstimatorFlags, EstimatorName, EyeModel, OutputFile, Result, Strict, Threads
from .output import Heed, emit, progress

if TYPE_CHECKING:
    from ..gaze.columns import CsvColumns

UNITS = ["mm", "px", "deg"]
PLACES = {
    "given": "as the records have it",
    "rays": "estimated as the origin of the estimator's gaze rays",
    "glints": "estimated from the glints, with an average cornea",
}
"""Words for the source of the eye's position, by its code."""

MOST_SHOWN = 50
"""Most targets, and most records that were left out, that are printed."""

gaze = App(name="gaze", help="Estimate gaze from records of features, also from real images.")
app.command(gaze)


def _positive(_type: Any, value: tuple[float, float] | None) -> None:
    if value is not None and not all(0 < side <= 1e6 for side in value):
        raise ValueError("must be two numbers > 0")


def _columns(columns: Path | None, screen_px: tuple[float, float] | None, table: Path) -> Path | CsvColumns | None:
    """Add the size of the screen, where it is given, to the meaning of a table's columns."""
    from ..gaze.columns import CsvColumns
    from ..gaze.records import is_table

    if screen_px is None or (columns is None and not is_table(table)):
        return columns
    known = CsvColumns() if columns is None else CsvColumns.load(columns)
    return known.model_copy(update={"screen_px": screen_px})


@gaze.command(name="fit")
def fit(
    records: Path,
    /,
    *,
    estimator: EstimatorName,
    output: OutputFile,
    scene: str | None = None,
    rig: str | None = None,
    columns: Path | None = None,
    targets: Path | None = None,
    screen_px: Annotated[tuple[float, float] | None, Parameter(validator=_positive)] = None,
    options: Annotated[EstimatorFlags, Parameter(name="*")] = EstimatorFlags(),
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Calibrate a gaze estimator on records with known targets, and write the calibration.

    Args:
        records: Records as `features` or `extract` write them (JSON), one record per line (JSONL), or a table (CSV).
            Each needs its target, or `--targets`.
        output: The calibration file to write.
        scene: A scene file or the name of a shipped one, for its rig (default: the rig in the records' file).
        rig: A rig file or a scene file, for its rig.
        columns: A YAML file with the meaning of a table's columns (default: recognised from their names).
        targets: A table of targets by frame, or by the time from which each is shown.
        screen_px: Width and height of the screen in px, for targets in px.
    """
    from ..gaze.records import load_observations
    from ..gaze.store import fit_estimator, save_estimator
    from ..gaze.table import with_targets

    chosen, fixations = options.choose(estimator), options.fixation_list()
    heed = Heed(strict)
    observations, built = load_observations(
        records, None if scene is None else heed.scene(scene), rig=rig, columns=_columns(columns, screen_px, records)
    )
    if targets is not None:
        observations = with_targets(observations, targets, _columns(columns, screen_px, targets), built)
    fitted, summary = fit_estimator(chosen, observations, built, fixations, source=str(records), warn=heed)
    save_estimator(output, fitted, built)
    summary = {**summary, "path": str(output)}
    text = f"{estimator}: calibrated on {summary['calibration_observations']} observations, written to {output}"
    for unit in ("deg", "mm"):
        error = summary[f"calibration_error_{unit}"]
        if error["n"]:
            text += f"\nerror on them (not a test): mean {error[f'mean_{unit}']:.4f} {unit} over {error['n']}"
    text += _targets_table(summary["targets"])
    for one in summary["left_out"][:MOST_SHOWN]:
        text += f"\nleft out: frame {one['frame']}, {one['eye']} eye: {one['reason']}"
    if len(summary["left_out"]) > MOST_SHOWN:
        text += f"\nleft out: {len(summary['left_out']) - MOST_SHOWN} more records"
    emit(summary, text, json, heed)
    return 0


def _targets_table(targets: list[dict[str, Any]]) -> str:
    """Format the mean residual at each target."""
    lines = [f"\n{'eye':<8} {'target mm':>26} {'records':>8} {'residual deg':>13}"]
    for one in targets[:MOST_SHOWN]:
        place = ", ".join(f"{v:.4g}" for v in one["target_mm"])
        lines.append(f"{one['eye']:<8} {place:>26} {one['records']:>8} {_cell(one['mean_deg'], '.3f'):>13}")
    if len(targets) > MOST_SHOWN:
        lines.append(f"{len(targets) - MOST_SHOWN} more targets: --json")
    return "\n".join(lines)


@gaze.command(name="predict")
def predict(
    records: Path,
    /,
    *,
    calibration: Annotated[Path, Parameter(name=["--calibration", "-c"])],
    estimator: str | None = None,
    scene: str | None = None,
    rig: str | None = None,
    columns: Path | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    screen_px: Annotated[tuple[float, float] | None, Parameter(validator=_positive)] = None,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Estimate gaze points, or rays if the rig has no screen, with a calibration written by `gaze fit`.

    Where the targets are known, the errors are reported too: on the screen in mm and px, and in degrees at the eye. The
    place of the eye is the records' own, or it is estimated. A summary has mean, median and 95th percentile of the
    errors, and the data loss: the share of samples without an estimate.

    Args:
        records: Records as `features` or `extract` write them (JSON), one record per line (JSONL), or a table (CSV).
        calibration: The calibration file.
        estimator: Your own class as module:Class, if it made the calibration. The file alone never imports code.
        scene: A scene file or the name of a shipped one, for its rig (default: the rig in the records' file).
        rig: A rig file or a scene file, for its rig.
        columns: A YAML file that says what the columns of a table are (default: as their names say).
        output: A table (CSV) of the gaze: time_s, frame, eye, x_px, y_px, x_deg, y_deg, valid.
        screen_px: Width and height of the screen in px, for errors, gaze and targets in px.
    """
    from ..base.storage.files import refuse_special, write_text
    from ..gaze.builtin import BuiltIn
    from ..gaze.columns import CsvColumns
    from ..gaze.conventions import convention_warnings
    from ..gaze.predictions import gaze_csv, predictions, refuse_nothing
    from ..gaze.rays import eye_name
    from ..gaze.records import load_observations
    from ..gaze.store import load_calibration
    from ..rig.plausibility import rig_warnings

    heed = Heed(strict)
    fitted, calibrated = load_calibration(calibration, estimator)
    observations, built = load_observations(
        records, None if scene is None else heed.scene(scene), rig=rig, columns=_columns(columns, screen_px, records)
    )
    other = [] if calibrated is None else rig_warnings(built, calibrated, scene or rig or str(records))
    heed(other or convention_warnings(observations, built, str(records)))
    if screen_px is None and columns is not None:
        screen_px = CsvColumns.load(columns).screen_px
    if output is not None:
        refuse_special(output)
        if screen_px is None and built.screen is not None:
            reason = "the screen's size in px is not known, so x_px and y_px are empty; give --screen-px WIDTH HEIGHT"
            heed([InputWarning(code="screen-px", reason=reason, source=str(output))])
    data = predictions(fitted, observations, built, screen_px)
    known = [eye_name(eye) for eye in fitted.eyes()] if isinstance(fitted, BuiltIn) else []
    refuse_nothing(data, known, source=str(records))
    if output is not None:
        write_text(output, gaze_csv(data, built, screen_px))
    emit(data, _gaze_table(data), json, heed)
    return 0


def _gaze_table(data: dict[str, Any]) -> str:
    from ..gaze.predictions import RAYS_SCHEMA

    rays = data["schema"] == RAYS_SCHEMA
    key, title, units = "point_mm", "gaze point mm", UNITS
    if rays:
        key, title, units = "direction", "gaze direction (unit vector)", ["deg"]
    lines = [f"{'frame':>6} {'eye':<6} {title:>33}" + "".join(f"{f'error {unit}':>11}" for unit in units)]
    both = [{**entry, "eye": "both"} for entry in data["binocular"] if entry["point_mm"] is not None]
    for entry in [*data["gaze"], *both]:
        point = entry[key]
        where = f"missing: {entry['reason']}" if point is None else "".join(f"{v:>11.3f}" for v in point)
        errors = "".join(_cell(entry[f"error_{unit}"], ".3f") for unit in units)
        lines.append(f"{entry['frame']:>6} {entry['eye'] or '-':<6} {where:>33}{errors}")
    lines += ["", f"{'eye':<6} {'samples':>8} {'data loss':>10}  {'in':<6}{'mean error':>11}{'median':>11}{'95 %':>11}"]
    for entry in data["summary"]:
        start = f"{entry['eye'] or '-':<6} {entry['samples']:>8} {entry['data_loss']:>10.1%}"
        known = [unit for unit in units if entry[f"error_{unit}"] is not None]
        for unit in known or ["-"]:
            figures = entry.get(f"error_{unit}") or {}
            numbers = "".join(_cell(figures.get(name), ".3f") for name in ("mean", "median", "p95"))
            lines.append(f"{start}  {unit:<6}{numbers}")
            start = " " * len(start)
    for entry in data["summary"]:
        if entry["quality"]:
            values = {name: _cell(value, ".3g").strip() for name, value in entry["quality"].items()}
            lines.append(
                "{eye}: medians of {fixations} fixations: accuracy {accuracy_deg} deg, RMS-S2S {rms_s2s_deg} deg, "
                "SD {sd_deg} deg, their ratio {s2s_over_sd}, BCEA {bcea_deg2} deg^2, data loss {data_loss}".format(
                    eye=entry["eye"] or "-", **values
                )
            )
    for entry in data["summary"]:
        parts = (f"{word} {_event_cell(one)}" for word, one in (entry["by_event"] or {}).items())
        lines += [f"{entry['eye'] or '-'}, median error and loss: {', '.join(parts)}"] if entry["by_event"] else []
    lines += [f"degrees: place of the eye {PLACES[place]}" for place in PLACES if _uses(data, place)]
    return "\n".join(lines)


def _event_cell(figures: dict[str, Any]) -> str:
    error = figures["error_deg"]
    return f"{'-' if error is None else format(error['median'], '.3g')} deg, {figures['data_loss']:.1%}"


def _cell(value: float | None, form: str) -> str:
    return f"{'-' if value is None else format(value, form):>11}"


def _uses(data: dict[str, Any], place: str) -> bool:
    return any(place in entry["eye_place"] and entry["error_deg"] is not None for entry in data["summary"])


@app.command(name="budget")
def budget(
    scene: str,
    /,
    *,
    estimator: EstimatorName,
    eye: EyeModel = None,
    options: Annotated[EstimatorFlags, Parameter(name="*")] = EstimatorFlags(),
    binocular: bool = False,
    reference: str = "E1",
    seeds: AtLeastOne = None,
    images: Annotated[bool, Parameter(negative="--no-images")] = True,
    backend: Backend = "auto",
    threads: Threads = None,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Split the gaze error of a scene by cause: eye model, features, image, noise, estimator.

    The images are rendered once and exposed again for each seed of the noise. With --fixations the remaining ones are
    tested; otherwise each fixation is tested with a calibration on all others.

    Args:
        scene: A scene file or the name of a shipped one, with targets.
        binocular: Use the mean of both eyes' gaze points. It hides horizontal errors of eyes that are mirror images of
            each other.
        reference: Eye model that gives the estimator's own error.
        seeds: Number of exposures of each image with other noise (default: 10).
        images: Render images; without them only eye model and optics are separated.
    """
    from ..gaze.budget import budget as split
    from ..imaging.causes import SEEDS, budget_steps

    chosen, calibration = options.choose(estimator), options.fixation_list()
    heed = Heed(strict)
    loaded = heed.scene(scene, eye=eye)
    frames = loaded.frames()
    unknown = sorted(set(calibration or ()) - set(frames.index.fixation.tolist()))
    if unknown:
        raise InputError(f"there is no fixation {unknown[0]}", source="--fixations")
    try:
        with progress(f"budget {scene}") as steps:
            observed = budget_steps(
                frames, reference=reference, images=images, seeds=seeds or SEEDS, backend=backend, threads=threads,
                progress=steps,
            )  # fmt: skip
        found = split(observed, loaded.rig, chosen, calibration=calibration, binocular=binocular)
    except InputError as error:
        raise error.placed(source=scene) from None
    data = {"scene": loaded.name, "eye_model": loaded.eye_spec.name, "estimator": estimator, "reference": reference}
    emit({**found.to_mapping(), **data}, str(found), json, heed)
    return 0
