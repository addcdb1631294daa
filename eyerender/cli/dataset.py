"""Commands for datasets: generate, sample, preview, validate, status, merge, export-dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from ..base.errors import EyerenderError, InputError
from ..dataset.options import PlanOptions, RunOptions
from .app import app
from .options import AtLeastOne, Backend, EyeModel, OutputFile, OutputFolder, Overwrite, Result, Seed, Strict, Threads
from .output import Heed, emit, progress, say

if TYPE_CHECKING:
    from ..dataset.plan import Plan


@app.command(name="generate")
def generate(
    spec: str,
    /,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    *,
    shard: str | None = None,
    dry_run: bool = False,
    measure: bool = False,
    eye: EyeModel = None,
    seed: Seed = None,
    count: int | None = None,
    scenes: str | None = None,
    changes: Annotated[PlanOptions, Parameter(name="*")] = PlanOptions(),
    options: Annotated[RunOptions, Parameter(name="*")] = RunOptions(),
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Make a labelled dataset, or resume an interrupted one.

    Started again on the same folder, the command makes only what is missing. Ctrl-C or SIGTERM (`kill PID`) stops it
    and keeps what is finished. For a command in the background of a shell script, use SIGTERM: the shell makes it
    ignore Ctrl-C. If more than 2 % of the samples could not be made, the exit code is 1.

    Args:
        spec: A dataset file, the name of a shipped one, or MODULE:FUNCTION, which gives the scene of (seed, i).
        output: The folder to write.
        shard: K/N: make only every N-th shard, starting with the K-th (1 <= K <= N). Use it for array jobs that write
            to one folder.
        dry_run: Only estimate the time and the disk space, from the last measured rate of this spec on this machine.
        measure: With --dry-run, make a few samples to measure the rate.
        count: Make COUNT samples of the spec's plan, spread over its subjects. Beyond the plan, new subjects are added.
            A folder that holds more or fewer samples keeps those that are wanted.
        scenes: MODULE:FUNCTION, which gives the scenes in place of those of the spec.
    """
    part = part_of(shard)
    if measure and not dry_run:
        raise InputError("needs --dry-run", source="--measure")
    if output is None and not dry_run:
        raise InputError("give the folder to write", source="--output")
    if options.overwrite and shard is not None:
        raise InputError(
            "cannot be combined with --shard, because other jobs may be writing to the folder", source="--overwrite"
        )
    from ..dataset.plan import Plan

    heed = Heed(strict)
    plan = Plan.load(spec, scenes=scenes, eye=eye, seed=seed, count=count, changes=changes)
    if output is None or dry_run:
        from ..dataset.estimate import estimate

        found = estimate(plan, options, measure=measure, warn=heed)
        emit(found, _estimate_text(found), json, heed)
        return 0
    from ..dataset.run import GIVEN_UP_SHARE
    from ..dataset.run import generate as run

    with progress("generating") as steps:
        done = run(plan, output, options, part=part, progress=steps, say=say, warn=heed)
    emit(done, "\n".join([*_generate_lines(done), *_shard_lines(plan)]), json, heed)
    found = done.get("statistics", {"samples_given_up": 0})
    return EyerenderError.exit_code if found["samples_given_up"] > GIVEN_UP_SHARE * plan.spec.count else 0


@app.command(name="sample")
def sample(
    spec: str,
    index: Annotated[int, Parameter(name="I", allow_leading_hyphen=True)],
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    eye: EyeModel = None,
    seed: Seed = None,
    changes: Annotated[PlanOptions, Parameter(name="*")] = PlanOptions(),
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Show the subject, the drawn values and the scene of one sample.

    Args:
        spec: A dataset file, or the name of a shipped one.
        index: The index of the sample, counted from 0.
        output: A folder for scene.yaml and eye.yaml, which other commands can read.
    """
    import yaml

    from ..dataset.plan import Plan, is_function
    from ..dataset.realise import sample as drawn

    count = max(index, 0) + 1 if is_function(spec) else None
    found = drawn(Plan.load(spec, eye=eye, seed=seed, count=count, changes=changes), index)
    heed = Heed(strict)
    heed(found.warnings())
    if output is not None:
        found.write(output)
    data = found.to_mapping()
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=100).rstrip()
    emit(data, text, json, heed)
    return 0


@app.command(name="preview")
def preview(
    spec: Annotated[str, Parameter(name="SCENE_OR_SPEC")],
    /,
    *,
    output: OutputFile,
    eye: EyeModel = None,
    seed: Seed = None,
    backend: Backend = "auto",
    threads: Threads = None,
    planned: bool = False,
    strict: Strict = False,
) -> int:
    """Render a contact sheet of 16 images of a scene or a dataset.

    The sheet is for looking at, not for measurements.

    Args:
        spec: A scene or dataset file, or the name of a shipped one.
        output: The picture to write.
        planned: Draw the outlines of pupil, iris and lids and the glints of a dataset's samples, without rendering.
    """
    from ..dataset.sheet import preview as render
    from ..dataset.sheet import preview_outlines

    heed = Heed(strict)
    with progress("drawing" if planned else "rendering") as steps:
        if planned:
            preview_outlines(spec, output, eye=eye, seed=seed, progress=steps, warn=heed)
        else:
            render(spec, output, eye=eye, seed=seed, backend=backend, threads=threads, progress=steps, warn=heed)
    print(output)
    return 0


@app.command(name="validate")
def validate(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *,
    quick: bool = False,
    deep: bool = False,
    render: int = 0,
    backend: Backend = "auto",
    threads: Threads = None,
    json: Result = None,
) -> int:
    """Check a folder's files, labels and masks, and print statistics.

    The command compares files with their checksums, computes records and labels again from pose and parameters, and
    compares masks with the apparent pupil outlines. The exit code is 1 if anything is wrong.

    Args:
        folder: A folder written by render, quickstart or generate.
        quick: Do not open or hash the pictures. This still finds missing files and wrong sizes, but no changed bytes or
            wrong masks.
        deep: Recompute every line of metadata. By default 64 lines are recomputed, one from each 64th of the file; a
            folder with at most 64 lines is checked completely.
        render: Number of a dataset's images to render again and compare pixel by pixel.
    """
    from ..dataset.validate import validate as check

    with progress("validating") as steps:
        report = check(folder, quick=quick, deep=deep, render=render, backend=backend, threads=threads, progress=steps)
    emit(report, _validate_text(report), json)
    return 0 if report["ok"] else EyerenderError.exit_code


@app.command(name="status")
def status(folder: Annotated[Path, Parameter(name="DIR")], /, *, watch: bool = False, json: Result = None) -> int:
    """Show the progress of a dataset's run: rates by host, time left, retries, stalled parts, and disk space.

    Args:
        folder: A folder that generate writes.
        watch: Repeat every ten seconds until the run has ended.
    """
    import time

    from ..dataset.status import status as look

    found = look(folder)
    while watch and found["state"] == "running":
        emit(found, _status_text(found), json)
        time.sleep(10)
        found = look(folder)
    emit(found, _status_text(found), json)
    return 0


@app.command(name="merge")
def merge(*folders: Path, output: OutputFile, json: Result = None) -> int:
    """Join the parts of a dataset that machines without a shared file system made with `generate --shard K/N`.

    Args:
        folders: The folders of the parts.
        output: The folder to write; it may already hold some of the shards.
    """
    from ..dataset.merge import merge as join

    with progress("merging") as steps:
        found = join(folders, output, progress=steps)
    missing = found["shards_missing"]
    images = "" if missing else f": {found['statistics']['images']} images"
    emit(found, f"{output}{images}" + (f": {missing} shards are still missing" if missing else ""), json)
    return 0


@app.command(name="export-dataset")
def export_dataset(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    output: OutputFolder,
    *,
    format: Literal[
        "webdataset",
        "imagefolder",
        "coco",
        "yolo-seg",
        "yolo-pose",
        "csv",
        "parquet",
        "labels",
        "openeds",
        "ellseg",
        "teyed",
        "video",
        "bids",
    ],
    bits: Literal[8, 16] = 8,
    encoding: Literal["stored", "linear", "gamma"] | None = None,
    gain: float | None = None,
    workers: AtLeastOne = 1,
    shuffle: int | None = None,
    speed: float = 1.0,
    screen_px: tuple[int, int] = (1920, 1080),
    overwrite: Overwrite = False,
    json: Result = None,
) -> int:
    """Convert a generated dataset to a layout that existing training code reads.

    Args:
        folder: A folder written by generate.
        format: The layout.
        bits: Bits per pixel of the images: 8, or 16 for webdataset, imagefolder, coco, csv, parquet and video.
        encoding: The codes as the camera stored them, linear, or with a gamma of 2.2 (default: as stored if the dataset
            has 8 bits; else gamma for 8 bits, linear for 16 bits).
        gain: Exposure gain of linear or gamma images (default: measured on a sample of the images; 1 for 16-bit linear
            images).
        workers: Number of processes that read and encode images. The bytes do not depend on it.
        shuffle: Write the images in a random order with this seed, instead of that of the samples (not teyed, labels,
            video, bids).
        speed: With --format video: how fast the videos to look at run; 0.1 is a tenth of the speed of the recording.
        screen_px: With --format bids: width and height of the screen in pixels.
    """
    from ..dataset.export import export

    heed = Heed(strict=False)
    with progress("exporting") as steps:
        done = export(
            folder,
            format,
            output,
            bits=bits,
            encoding=encoding,
            gain=gain,
            workers=workers or 1,
            shuffle=shuffle,
            speed=speed,
            screen_px=screen_px,
            overwrite=overwrite,
            progress=steps,
            warn=heed,
        )
    text = f"{done['images']} images as {format} in {output}"
    if image := done["image"]:  # the layout labels has none
        gained = "" if image["encoding"] == "stored" else f", gain {image['gain']:g}"
        text += f" ({bits} bits, {image['encoding']}{gained})"
    emit(done, text, json, heed)
    return 0


def part_of(text: str | None) -> tuple[int, int]:
    """Parse K/N of --shard; without the option, return the whole.

    Raises:
        InputError: the text has another form.
    """
    if text is None:
        return 1, 1
    k, slash, n = text.partition("/")
    if not (slash and k.isdigit() and n.isdigit() and 1 <= int(k) <= int(n)):
        raise InputError(f"must be K/N with 1 <= K <= N, not {text!r}", source="--shard")
    return int(k), int(n)


def _shard_lines(plan: Plan) -> list[str]:
    """Say how full the shards are where fewer samples than those of the plan are made."""
    spec, shards = plan.spec, len(plan.spec.shards)
    if spec.count >= spec.planned_count or shards < 2 or spec.count / shards >= spec.shard_size / 2:
        return []
    return [
        f"the {shards} shards hold {spec.count / shards:.1f} samples on average; a larger --count fills them, "
        f"up to {spec.shard_size} each"
    ]


def _generate_lines(done: dict[str, Any]) -> list[str]:
    lines = [f"{done['images_made']} images made in {done['seconds']:.1f} s ({done['shards_made']} shards)"]
    if not done["complete"]:
        lines.append(f"{done['shards_missing']} shards are still missing")
        return lines
    s = done["statistics"]
    splits = ", ".join(f"{name} {n}" for name, n in s["images_by_split"].items())
    lines.append(f"{s['images']} images in {done['path']}: {splits}; {s['bytes_per_image']} bytes per image")
    if s["attempts_rejected"]:
        given = s["samples_given_up"]
        lines.append(f"{s['attempts_rejected']} attempts redrawn, {given} samples given up (see failures.jsonl)")
    if done["splits_empty"]:
        lines.append(f"no image is in {', '.join(done['splits_empty'])}: more subjects are needed for all splits")
    return lines


def _estimate_text(found: dict[str, Any]) -> str:
    rate = found["rate"]
    text = f"{found['images']} images in {found['shards']} shards, {found['workers']} workers"
    if rate is None:
        why = "this spec was never measured on this machine; use --measure"
        return f"{text}: time and disk space are unknown, because {why}"
    how = "measured" if rate["how"] == "measured" else "of a run"
    return (
        f"{text} of {found['threads_per_worker']} threads on {rate['backend']}: about {_duration(found['seconds'])}, "
        f"{_size(found['bytes'])} (rate {how} with {rate['samples']} samples, {rate['time']})"
    )


def _status_text(found: dict[str, Any]) -> str:
    done, partial = found["samples_finished"], found["samples_in_partial_shards"]
    more = f" and {partial} in partial shards" if partial else ""
    lines = [
        f"{found['state']}: {done}{more} of {found['samples']} samples, "
        f"{found['shards_finished']} of {found['shards']} shards, {found['retries']} retries"
    ]
    if found["images_per_s"] is not None:
        left = found["seconds_left"]
        lines.append(f"{found['images_per_s']:.2f} images/s, {'' if left is None else _duration(left) + ' left'}")
    if found["bytes_left"]:
        lines.append(f"{_size(found['bytes_left'])} to write, {_size(found['bytes_free'])} free")
    for part in found["parts"]:
        rate = "" if part["images_per_s"] is None else f", {part['images_per_s']:.2f} images/s"
        retries = f", {part['retries']} retries" if part["retries"] else ""
        lines.append(
            f"  {part['host']} {part['part']}: {part['state']}, {part['images']} images{rate}{retries}, {part['last']}"
        )
    return "\n".join(lines)


def _duration(seconds: float) -> str:
    """Format a duration for reading, in seconds up to days."""
    if seconds < 3600:
        minutes, rest = divmod(round(seconds), 60)
        return f"{minutes} min {rest} s"
    return f"{seconds / 3600:.1f} h" if seconds < 2 * 86400 else f"{seconds / 86400:.1f} days"


def _size(count: int) -> str:
    """Format a size for reading, in MB up to TB."""
    unit, name = next(u for u in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB")) if count >= u[0] or u[0] == 1e6)
    return f"{count / unit:.1f} {name}"


def _short(value: Any) -> str:
    """Format a statistic for reading: numbers with four digits, lists and mappings on one line."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {_short(one)}" for key, one in value.items())
    if isinstance(value, list | tuple):
        return " ".join(map(_short, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _validate_text(report: dict[str, Any]) -> str:
    lines = [f"{report['images']} images checked, {report['recomputed']} of them computed again", *report["notes"]]
    for key, value in report["statistics"].items():
        lines.append(f"{key:<22} {_short(value)}")
    lines += [f"wrong: {problem}" for problem in report["problems"]]
    if report["problems_left_out"]:
        lines.append(f"and {report['problems_left_out']} more")
    lines.append("all is well" if report["ok"] else f"{report['problem_count']} problems")
    return "\n".join(lines)
