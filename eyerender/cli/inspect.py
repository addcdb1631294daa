"""The command inspect."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..base.errors import InputError
from .app import app
from .options import AtLeastOne, Result
from .output import emit, progress


@app.command(name="inspect")
def inspect(
    folder: Annotated[Path, Parameter(name="DIR")],
    other: Annotated[Path | None, Parameter(name="OTHER")] = None,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    images: int = 100_000,
    planned: bool = False,
    workers: AtLeastOne = None,
    json: Result = None,
) -> int:
    """Look into a dataset: its contents, what is wrong or unusual, duplicates, splits, distributions.

    With a second dataset, the command also says which distributions differ.

    Args:
        folder: A folder written by generate, or by render; with --planned a dataset spec.
        other: A second one, to compare with.
        output: An HTML page to write: contents, faults, shares, dependences, the worst pictures, distributions.
        images: The largest number of images that are read of a dataset, spread evenly over it.
        planned: Draw the samples of a spec instead of reading a folder: splits, distributions and dependences of draws.
        workers: Number of processes that read them (default: all processors).
    """
    from ..apps.inspection import inspect as look

    if output is not None and output.suffix.lower() not in (".html", ".htm"):
        raise InputError("must end with .html", source="--output")
    with progress("reading") as steps:
        cores = workers or os.cpu_count() or 1
        data = look(folder, other, output=output, images=images, planned=planned, workers=cores, progress=steps)
    page = f"\n\npage: {output}" if output is not None else ""
    emit(data, "\n".join(_text(data)) + page, json)
    return 0


def _text(data: dict[str, Any]) -> list[str]:
    lines = []
    for found in data["datasets"]:
        splits = ", ".join(f"{name} {own['images']}" for name, own in found["splits"].items())
        planned = "faults" not in found
        done = "samples drawn" if planned else "images read"
        lines.append(f"{found['path']}: {found['images_read']} of {found['images']} {done}; {splits}")
        lines += [f"  {text}" for text in _dependences(found["dependences"])]
        if planned:
            continue
        for kind, own in found["faults"].items():
            first = own["images"][0]
            more = f" and {own['count'] - 1} more" if own["count"] > 1 else ""
            lines.append(f"  {kind}: {first['image']}: {first['detail']}{more}")
        if not found["faults"]:
            lines.append("  no faults")
        for name, shares in found["shares"].items():
            lines.append(f"  {name}: " + ", ".join(f"{key} {share:.1%}" for key, share in shares.items()))
        for own in found["missing"]:
            names = ", ".join(own["labels"][:3]) + (", ..." if len(own["labels"]) > 3 else "")
            cause = f"; depends on {own['depends_on']} ({own['rank_correlation']:+.2f})" if own["depends_on"] else ""
            lines.append(f"  missing in {own['share']:.1%}: {names}{cause}")
        for outlier in found["outliers"][:5]:
            reason = outlier["reasons"][0]
            lines.append(f"  unusual: {outlier['image']}: {reason['column']} {reason['value']:.4g}, {reason['usual']}")
    if data["difference"] is not None:
        columns, by = data["difference"]["columns"], data["difference"]["by"]
        moved = [s for s in columns if s["distance"] > s["chance"]]
        lines.append(f"compared by {by}: {len(moved)} of {len(columns)} numbers differ; chance gives one in twenty")
        for shift in moved[:10]:
            before, after = shift["medians"]
            lines.append(f"  {shift['column']}: distance {shift['distance']:.3f}, median {before:.4g} and {after:.4g}")
    return lines


def _dependences(found: list[dict[str, Any]] | None) -> list[str]:
    if found is None:
        return ["dependences: not tested, which needs 60 subjects"]
    named = [one for one in found if not one["declared"]]
    texts = [
        f"dependence: {one['a']} and {one['b']} (rank correlation {one['rank_correlation']:+.2f})" for one in named
    ]
    return texts or ["no dependence of draws and labels that the spec does not declare"]


@app.command(name="realism")
def realism(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *other: Annotated[Path, Parameter(name="OTHER")],
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    gamma: tuple[float, ...] = (),
    limit: int = 200,
    json: Result = None,
) -> int:
    """Measure image statistics of eye pictures: contrasts, edges, texture, highlights, noise.

    With a second folder, such as frames of your own camera, the command compares both. A classifier then measures how
    well patches of the two can be told apart; this needs scikit-learn, which is not installed by default. With folders
    of three or more cameras, it is trained on all cameras but one and tested on that one.

    Args:
        folder: A folder of images of one eye each: written by this package, exported by it, or your own.
        other: A second folder, to compare with, or a folder for each of several cameras.
        output: An HTML page to write, with the table and montages at equal scale.
        gamma: Encoding gamma of the pixel values; give it twice for two folders. Default: the value that a folder of
            this package or an export states, else 1 (linear).
        limit: The largest number of images of a folder, chosen evenly.
    """
    from ..apps.realism import realism as measured

    if output is not None and output.suffix.lower() not in (".html", ".htm"):
        raise InputError("must end with .html", source="--output")
    folders = [folder, *other]
    with progress("measuring") as steps:
        data = measured(folders, output=output, gammas=gamma, limit=limit, progress=steps)
    page = f"\n\npage: {output}" if output is not None else ""
    emit(data, _table(data) + page, json)
    return 0


def _table(data: dict[str, Any]) -> str:
    """Format one line per statistic: median and middle half of each folder's images, and the ratio of the medians."""
    from ..apps.realism.page import text

    folders, ratios = data["folders"], data["ratios"]
    lines = []
    for k, f in enumerate(folders):
        lines.append(
            f"{chr(65 + k)}: {f['path']}: {f['measured']} of {f['images']} images, gamma {f['gamma']:g} "
            f"({f['gamma_from']}), pupil and iris from: {f['landmarks']}"
        )
    heads = "".join(f"{chr(65 + k):>10} {'middle half':>19}" for k in range(len(folders)))
    lines += ["", f"{'':<24}{heads}{'A / B':>9}" if ratios else f"{'':<24}{heads}"]
    for name in data["definitions"]:
        cells = ""
        for f in folders:
            s = f["figures"][name]
            spread = f"[{text(s['q25'])}, {text(s['q75'])}]" if s["n"] else ""
            cells += f"{text(s['median']):>10} {spread:>19}"
        lines.append(f"{name:<24}{cells}" + (f"{text(ratios[name]):>9}" if ratios else ""))
    return "\n".join([*lines, *_test(data)])


def _test(data: dict[str, Any]) -> list[str]:
    """Format one line per kind of patch: how well the two folders can be told apart."""
    if len(data["folders"]) < 2:
        return []
    if len(data["folders"]) > 2:
        lines = [
            "",
            f"{'told from an unseen camera':<28}{'AUC':>6} {'90 % interval':>15}{'a camera':>10} {'90 % interval':>15}",
        ]
        for kind, found in (data["left_out"] or {}).items():
            if found is None:
                lines.append(f"{kind:<28}{'-':>6} {'too few images':>15}")
                continue
            own, placebo = ("[{:.2f}, {:.2f}]".format(*found[f"{name}interval_90"]) for name in ("", "placebo_"))
            lines.append(f"{kind:<28}{found['auc']:>6.2f} {own:>15}{found['placebo']:>10.2f} {placebo:>15}")
        return lines
    if data["separability"] is None:
        return ["", f"two-sample test: {data['separability_reason']}"]
    lines = ["", f"{'told apart (.5 chance)':<24}{'AUC':>10} {'90 % interval':>19}{'images':>12}"]
    for kind, found in data["separability"].items():
        if found is None:
            lines.append(f"{kind:<24}{'-':>10} {'too few images':>19}")
            continue
        low, high = found["interval_90"]
        images = "{} and {}".format(*found["images"])
        lines.append(f"{kind:<24}{found['auc']:>10.2f} {f'[{low:.2f}, {high:.2f}]':>19}{images:>12}")
    return lines
