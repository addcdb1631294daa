"""Sweeps of rigs: each layout over a population, on all processors, resumable, in shards; then the Pareto front.

Each finished layout is a file in `layouts/`, which a later run keeps. The result of a layout depends on nothing but the
sweep and the layout's number.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Bools
from ...base.errors import EyerenderError, InputError
from ...base.processes import process_pool
from ...base.progress import Progress, Say, notify
from ...base.storage.files import csv_text, make_folder, read_json, write_json, write_text
from ...base.storage.lock import final_lock, run_lock
from ...design.choice import choose_lights, noise_of_some
from ...design.crowd import coverage_of, covered, gaze_of
from ...design.eyebox import eye_box_mm, eye_box_of, field_share, sharp_depth_mm
from ...design.noise import FeatureNoise, sensor_noise
from ...design.people import RigPopulation, figures_of, sites_seen
from ...design.safety import eye_exposure
from ...design.tolerances import UNIT_PEOPLE, of_this_eye, tolerated
from ...design.unknowns import Unknowns
from ...folders.outfolder import clear, refuse_non_empty
from ...gaze.likelihood import GLINT_PX, OUTLINE_PX
from ...scene import Scene
from ...scene.spec import SceneSpec
from .page import write_report
from .spec import RigLayout, SweepSpec, layouts_of

SCHEMA, LAYOUT_SCHEMA = "eyerender/sweep/1", "eyerender/sweep-layout/1"
MARKER, SUMMARY, TABLE, LAYOUTS, REPORT = "sweep.json", "summary.json", "layouts.csv", "layouts", "report.html"
CHOOSERS = 12
"""People whose information chooses LEDs."""
GOALS = {"noise_deg": 1, "dropout": 1, "leds": 1, "cornea_w_m2": 1, "sharp_depth_mm": -1, "field": -1, "units_deg": 1}
"""Quantities that define the Pareto front: of those with 1 a good layout has little, of those with -1 much."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepRun:
    """Options of a sweep run."""

    workers: int | None = None  # processes; None: one for each processor
    part: tuple[int, int] = (1, 1)  # (K, N): evaluate only every N-th layout, beginning with the K-th
    overwrite: bool = False  # replace the contents of the folder


def run_sweep(
    spec: SweepSpec,  # the sweep
    scene: Scene,  # the sweep's base scene (`spec.base`)
    output: str | Path,  # the folder, which may hold a part of the same sweep
    how: SweepRun = SweepRun(),  # options of the run
    *,
    progress: Progress | None = None,  # called with (layouts done, layouts of this run, what)
    say: Say = lambda _text: None,  # called with a message for each problem that does not end the run
) -> dict[str, Any]:
    """Evaluate the missing layouts of a sweep; once all are there, write summary.json, layouts.csv and report.html.

    Raises:
        InputError: a layout is impossible, a tolerance is that of no part, or the folder holds something else.
    """
    folder = Path(output)
    layouts = layouts_of(spec, scene)
    _check_tolerances(spec, layouts)
    settings = {"schema": SCHEMA, "sweep": _digest(spec, scene), "layouts": len(layouts), "spec": spec.to_mapping()}
    _claim(folder, settings, how.overwrite)
    k, n = how.part
    with run_lock(folder, how.part, say):
        mine = [layout for layout in layouts if layout.number % n == k - 1]
        missing = [layout for layout in mine if not _path(folder, layout.number).is_file()]
        done = len(mine) - len(missing)
        for number, record in _evaluated(spec, missing, how.workers):
            write_json(_path(folder, number), {"schema": LAYOUT_SCHEMA, **record})
            done += 1
            notify(progress, done, len(mine), "layouts")
    with final_lock(folder, say):
        absent = sum(not _path(folder, layout.number).is_file() for layout in layouts)
        if absent:
            return {"schema": SCHEMA, "complete": False, "layouts": len(layouts), "missing": absent}
        return _finish(folder, spec, scene, layouts)


def _path(folder: Path, number: int) -> Path:
    return folder / LAYOUTS / f"{number:06d}.json"


def _check_tolerances(spec: SweepSpec, layouts: Sequence[RigLayout]) -> None:
    """Check that tolerances name parts of the layouts; an LED that is chosen among places has no fixed number.

    Raises:
        InputError: naming the tolerance that does not fit.
    """
    if spec.tolerances is None:
        return
    scene, fewest = Scene.of(SceneSpec.from_mapping(layouts[0].scene)), min(layout.lights for layout in layouts)
    of_this_eye(scene, spec.tolerances)
    for k, one in enumerate(spec.tolerances.tolerances):
        if one.part == "led" and one.number != "all" and fewest < len(scene.rig.lights):
            raise InputError("LEDs are chosen among places; write all", path=f"tolerances.{k}.number")


def _digest(spec: SweepSpec, scene: Scene) -> str:
    content = {"spec": spec.to_mapping(), "scene": scene.located().to_mapping()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _claim(folder: Path, settings: Mapping[str, Any], overwrite: bool) -> None:
    """Create the folder for this sweep, or check that it belongs to it.

    Raises InputError if the folder holds something else; EyerenderError if the folder cannot be written.
    """
    marker = folder / MARKER
    try:
        if overwrite and marker.is_file() and folder.is_dir():
            clear(folder)
        if marker.is_file():
            if read_json(marker, follow=False).get("sweep") != settings["sweep"]:
                raise InputError("holds another sweep; choose another folder or give --overwrite", source=str(folder))
            return
        refuse_non_empty(folder, overwrite)
        make_folder(folder)
        if overwrite:
            clear(folder)
        (folder / LAYOUTS).mkdir(exist_ok=True)
        write_json(marker, settings)
    except OSError as error:
        raise EyerenderError(f"{folder}: cannot be written ({error.strerror or error})") from None


def _evaluated(
    spec: SweepSpec, layouts: Sequence[RigLayout], workers: int | None
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield results of layouts as worker processes finish them."""
    count = min(workers or os.cpu_count() or 1, len(layouts))
    if count <= 1:
        yield from ((layout.number, evaluate(spec, layout)) for layout in layouts)
        return
    todo = iter(layouts)
    with process_pool(count) as pool:
        running: dict[Future[dict[str, Any]], int] = {}

        def start(some: int) -> None:
            running.update({pool.submit(evaluate, spec, layout): layout.number for layout in islice(todo, some)})

        start(2 * count)
        while running:
            ready, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ready:
                yield running.pop(future), future.result()
            start(len(ready))


def evaluate(spec: SweepSpec, layout: RigLayout) -> dict[str, Any]:
    """Evaluate one layout: choose its LEDs, and compute bound, dropout, exposure and units over the population."""
    whole = Scene.of(SceneSpec.from_mapping(layout.scene))
    scene = whole.of_first_eye()
    survey = _survey(spec, scene.spec.to_mapping())
    sites, chosen = len(scene.rig.lights), tuple(range(len(scene.rig.lights)))
    if layout.lights < sites:
        (known,) = sites_seen(survey, [noise_of_some(scene, layout.lights)], min(CHOOSERS, spec.people))
        chosen = choose_lights(known, layout.lights)
        lights = [scene.spec.rig.lights[k] for k in chosen]
        scene = scene.with_({"rig.lights": lights})
        survey = _survey(spec, scene.spec.to_mapping())
    found = figures_of(survey, sensor_noise(scene), 0, spec.people)
    if not len(found.subject):
        raise InputError("no eye of this population is physically possible", path="population")
    coverage, seen = coverage_of(found), covered(found, min(2, len(scene.rig.lights)))
    noise = gaze_of(found.noise_deg, seen)
    return {
        "number": layout.number,
        "values": dict(layout.values),
        "leds": len(chosen),
        "chosen": list(chosen),
        "lights_mm": [light.position_mm.tolist() for light in scene.rig.lights],
        "people": len(found.subject),
        "frame_to_frame_deg": noise,
        "bound_deg": gaze_of(found.bound_deg, seen),
        "noise_deg": noise["median"],
        "coverage": coverage,
        "dropout": 1.0 - coverage["outline_and_2_glints"],
        "sharp_depth_mm": sharp_depth_mm(scene, spec.sharp_px),
        "field": field_share(scene, survey),
        **_exposure(scene),
        **_units(whole, scene, survey, spec),
    }


def _units(whole: Scene, scene: Scene, survey: RigPopulation, spec: SweepSpec) -> dict[str, Any]:
    """Compute what tolerances cost, and the median user's 95th-percentile error with drawn units."""
    if spec.tolerances is None:
        return {"tolerances": None, "units": None, "units_deg": None}
    weights = FeatureNoise.of(OUTLINE_PX, GLINT_PX, rig=scene.rig)
    own = of_this_eye(whole, spec.tolerances)
    found = tolerated(survey, spec.tolerances, own, weights, min(UNIT_PEOPLE, spec.people))
    return {**found, "units_deg": found["units"]["U50E95"]}


def _survey(spec: SweepSpec, scene: Mapping[str, Any]) -> RigPopulation:
    return RigPopulation(
        scene=scene,
        population=spec.people_of().to_mapping(),
        seed=spec.seed,
        azimuth_deg=spec.azimuth_deg,
        elevation_deg=spec.elevation_deg,
        slippage_mm=spec.slippage_mm,
        relief_mm=spec.relief_mm,
        unknowns=Unknowns.population().to_mapping(),
    )


def _exposure(scene: Scene) -> dict[str, Any]:
    """Compute the corneal irradiance at the scene's eye, or why it is unknown."""
    side = scene.spec.subject.eyes[0]
    place = scene.eye_position_mm(side) + np.array(scene.spec.subject.head_positions_mm[0])
    try:
        found = eye_exposure(scene.rig, place, wavelength_nm=scene.spec.wavelength_nm)
    except InputError as error:
        return {"cornea_w_m2": None, "cornea_share": None, "exposure_reason": str(error)}
    return {"cornea_w_m2": float(found.cornea_w_m2.sum()), "cornea_share": found.cornea_share, "exposure_reason": None}


def pareto(rows: Sequence[Mapping[str, Any]]) -> Bools:
    """Return which rows no other row dominates; an unknown value counts as the worst."""
    table = np.array(
        [[np.inf if row[goal] is None else sign * float(row[goal]) for goal, sign in GOALS.items()] for row in rows]
    )
    beaten = np.zeros(len(table), dtype=bool)
    for k, one in enumerate(table):
        beaten[k] = bool(((table <= one).all(axis=1) & (table < one).any(axis=1)).any())
    return ~beaten


def _finish(folder: Path, spec: SweepSpec, scene: Scene, layouts: Sequence[RigLayout]) -> dict[str, Any]:
    """Read all layouts and write the results."""
    rows = [_read(_path(folder, layout.number), layout.number) for layout in layouts]
    front, survey = pareto(rows), _survey(spec, scene.spec.to_mapping())
    rows = [
        {**{k: v for k, v in row.items() if k != "schema"}, "pareto": bool(best)}
        for row, best in zip(rows, front, strict=True)
    ]
    data = {
        "schema": SCHEMA,
        "complete": True,
        "scene": scene.name,
        "people": spec.people,
        "seed": spec.seed,
        "eye_box": {
            **eye_box_of(survey), "field_mm": eye_box_mm(survey).tolist(), "sharp_px": spec.sharp_px
        },
        "goals": [goal for goal in GOALS if any(row[goal] is not None for row in rows)],
        "layouts": len(rows),
        "pareto": [row["number"] for row in rows if row["pareto"]],
        "rows": rows,
    }  # fmt: skip
    write_json(folder / SUMMARY, data)
    write_text(folder / TABLE, _table(rows))
    write_report(folder / REPORT, data)
    return data


_KEYS = {
    "values", "leds", "chosen", "lights_mm", "people", "frame_to_frame_deg", "bound_deg", "noise_deg", "coverage",
    "dropout", "cornea_w_m2", "cornea_share", "sharp_depth_mm", "field", "units_deg",
}  # fmt: skip


def _read(path: Path, number: int) -> dict[str, Any]:
    """Read the result of a layout. Raises InputError if this package did not write the file."""
    row = read_json(path, follow=False)
    if row.get("schema") != LAYOUT_SCHEMA or row.get("number") != number or not row.keys() >= _KEYS:
        raise InputError(f"is not the result of layout {number}; remove it", source=str(path))
    return row


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format the layouts as CSV, one row each."""
    names = list(rows[0]["values"])
    plain = ("dropout", "leds", "cornea_w_m2", "cornea_share", "sharp_depth_mm", "field", "units_deg")
    header = ["layout", *names, "noise_deg", "U50E95_deg", "U95E95_deg", *plain, "chosen", "pareto"]
    lines = []
    for row in rows:
        users, chosen = row["frame_to_frame_deg"], " ".join(map(str, row["chosen"]))
        values = [json.dumps(row["values"][name]) for name in names]
        known = [row["noise_deg"], users["U50E95"], users["U95E95"], *(row[key] for key in plain)]
        lines.append([row["number"], *values, *known, chosen, row["pareto"]])
    return csv_text(header, lines)
