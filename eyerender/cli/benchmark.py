"""The command bench-extractors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..apps.benchmark.options import BenchOptions
from ..base.storage.files import read_json
from .app import app
from .options import OutputFolder, Result
from .output import emit, progress, say


@app.command(name="bench-extractors")
def bench_extractors(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *,
    output: OutputFolder,
    extractor: tuple[str, ...] = (),
    options: Annotated[BenchOptions, Parameter(name="*")] = BenchOptions(),
    json: Result = None,
) -> int:
    """Measure pupil and glint extractors against the labels of a folder of images.

    The output folder receives report.html, results.json, results.csv and times.json; only times.json differs between
    identical runs. Each extractor runs in its own process. If it crashes, hangs or returns invalid answers, only its
    own result fails, with a reason. An interrupted run leaves its answers in the output folder, and the same command
    resumes from them.

    The exit code is 1 if an extractor gives no usable answer to any image. With --against or --require it is also 1 if
    an extractor fails on any image, if a required figure is not reached, or if significantly more images were lost than
    gained (exact McNemar test, p < 0.05).

    Args:
        folder: A folder of labelled images: written by quickstart, render or generate, your own with labels.csv or
            masks, or in the layout of OpenEDS, TEyeD, COCO, LPW or ExCuSe. With --film: a video, or a folder.
        extractor: The name of an installed extractor (own-fast, own-refined, opencv-contour, pupil-detectors, or a
            plug-in), a Python module:callable, onnx:FILE for a network, or a command that speaks the protocol. NAME=...
            names it in the report. Repeat the option for several extractors (default: all installed ones).
    """
    from ..apps.benchmark.run import REPORT, TIMES, bench_extractors

    with progress("benching") as steps:
        data = bench_extractors(folder, output, extractor or None, options, progress=steps)
    for entry in data["gamma"]:
        if entry["from"] == "assumed":
            say(f"{entry['images']} images state no gamma; {entry['gamma']:g} (linear) is assumed (--gamma)")
    if data.get("centres_only"):
        say(f"{data['centres_only']} images have labels of the pupil's centre only; there, right is within 5 px of it")
    times = read_json(output / TIMES, limit=2**30, follow=False)
    emit(data, _film_table(data) if options.film else f"{_table(data, times)}\n\nreport: {output / REPORT}", json)
    for problem in data["problems"]:
        say(f"error: {problem}")
    return 1 if data["problems"] else 0


def _film_table(data: dict[str, Any]) -> str:
    """Format one line per extractor."""
    lines = [f"{'jitter':<18} {'found':>13} {'centre px':>10} {'radius px':>10} {'common: centre':>14} {'radius':>10}"]
    for e in data["extractors"]:
        s, found = e["summary"], f"{e['summary']['found']} of {data['images']}"
        own, common = ([_f(s[part][name], 4) for name in ("centre_px", "radius_px")] for part in ("jitter", "common"))
        lines.append(f"{e['name']:<18} {found:>13} {own[0]:>10} {own[1]:>10} {common[0]:>14} {common[1]:>10}")
    return "\n".join(lines + [f"{e['name']}: not run: {e['reason']}" for e in data["not_run"]])


def _table(data: dict[str, Any], times: dict[str, Any]) -> str:
    """Format one line per extractor, then the reasons of failures."""
    common = data["common"]
    lines = [
        f"{'':<18} {'right':>5} {'95 %':>14} {'wrong':>5} {'none':>5} {'error':>5} {'common px':>10} {'centre px':>10} "
        f"{'p95 px':>8} {'bias x px':>9} {'bias y px':>9} {'eff.':>5} {'axis a px':>9} {'axis b px':>9} "
        f"{'bound. px':>9} {'IoU':>6} {'glints':>9} {'gl. px':>7} {'ms':>6}"
    ]
    for e, spent in zip(data["extractors"], times["extractors"], strict=True):
        s, g, together = e["summary"], e["summary"]["glints"], common["extractors"].get(e["name"])
        bias, axes = s["centre_bias_px"] or (None, None), s["semi_axes_bias_px"] or (None, None)
        time = spent["cpu_ms"]["median"] or spent["round_trip_ms"]["median"]
        lines.append(
            f"{e['name']:<18} {s['right']:>5} {_span(s['intervals']['right']):>14} {s['wrong']:>5} {s['none']:>5} "
            f"{s['error']:>5} {_f(together['centre_px']['median'] if together else None, 4):>10} "
            f"{_f(s['centre_px']['median'], 4):>10} {_f(s['centre_px']['p95'], 4):>8} {_f(bias[0], 4):>9} "
            f"{_f(bias[1], 4):>9} {_f(s['efficiency']['value'], 2):>5} {_f(axes[0], 4):>9} {_f(axes[1], 4):>9} "
            f"{_f(s['boundary_px']['median'], 3):>9} {_f(s['iou']['median'], 3):>6} "
            f"{'-' if g is None else '{}/{}'.format(g['matched'], g['true']):>9} "
            f"{_f(g['error_px']['median'] if g else None, 4):>7} {_f(time, 1):>6}"
        )
    if common["n"]:
        lines.append(f"common px: median centre error on the {common['n']} pupils that all extractors find right")
    for e in data["extractors"]:
        if e["suggested_origin"]:
            lines.append(f"{e['name']}: {e['suggested_origin']['text']}")
    for e in data["extractors"]:
        lines += [f"{e['name']}: {f['count']} x {f['outcome']}: {f['reason']}" for f in e["failures"][:3]]
    for c in data["against"]:
        lines.append(
            f"{c['extractor']}: {c['successes_before']} -> {c['successes']} of {c['images']} right; "
            f"{len(c['lost'])} lost, {len(c['gained'])} gained (p = {c['p']:.2g})"
        )
    lines += [f"{e['name']}: not run: {e['reason']}" for e in data["not_run"]]
    return "\n".join(lines)


def _span(found: dict[str, Any]) -> str:
    """Format the 95 % interval of a rate: that of subjects, or Wilson's where there are less than two."""
    ends = found["subjects"] or found["wilson"]
    return "-" if ends is None else f"{ends[0]:.1%} - {ends[1]:.1%}"


def _f(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
