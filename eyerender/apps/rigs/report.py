"""The report on a rig: bound, dropout and coverage over a population, errors of estimators, and eye safety.

Ray optics gives all features; nothing is rendered. The features are exact, so an estimator's errors are its model bias
(wrong assumptions about people's eyes), without noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...backends.choose import BackendChoice
from ...base.arrays import Floats, Ints, finite_or_none
from ...base.errors import InputError
from ...base.progress import Progress, notify
from ...base.storage.files import csv_text, write_json, write_text
from ...design.crowd import SHIFTS_MM, coverage_of, covered, figures_of_people, figures_of_shifts, gaze_of, users_of
from ...design.eyebox import eye_box_of, eye_box_text
from ...design.lids import LEAST_SHARE
from ...design.noise import FIXATION_DEG, FeatureNoise, extracted_noise, sensor_noise
from ...design.people import CALIBRATION_CELLS, GRID, LOST, Figures, RigPopulation, fitted, place_of
from ...design.safety import BOX_MM, NOTE, eye_exposure
from ...design.tolerances import UNIT_PEOPLE, Tolerances, of_this_eye, tolerated
from ...design.unknowns import Unknowns
from ...folders.outfolder import staged
from ...gaze.estimate import ray_errors_deg
from ...gaze.likelihood import GLINT_PX, OUTLINE_PX
from ...gaze.store import choose_estimator
from ...imaging.imageobserver import ImageObserver
from ...optics.transforms import direction_of
from ...population.people import Person
from ...report.page import Card, Figure, Page, Section, Table, degrees_text, write_page
from ...report.style import heat_map
from ...rig.rig import RigGeometry
from ...scene import Scene
from ...scene.people import Population
from ...scene.spec import SceneSpec, Targets
from ...scene.subject import Subject
from .options import RigSize

SCHEMA = "eyerender/rig/1"
REPORT, PEOPLE, GAZE, SUMMARY = "report.html", "people.csv", "gaze.csv", "summary.json"
ESTIMATORS = ("direction-regression", "hennessey", "guestrin-eizenman", "maximum-likelihood")
NOISE_ONLY = "noise only"
TRAITS = ("age", "lids open (mm)", "fissure wide (mm)", "pupils apart (mm)")
_TARGET_MM = 1000.0
_SLIPPING = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Bias:
    """Errors of one estimator: (people, targets) degrees, NaN where there is no estimate; or a reason."""

    name: str
    error_deg: Floats
    reason: str = ""


def run_rig(
    # provides the rig, sensor, first eye and first head position; cameras and LEDs that serve only the other eye count
    # for eye safety alone
    scene: Scene,
    population: Population,  # the people
    output: str | Path,  # the folder
    size: RigSize = RigSize(),  # number of people, and range of gaze
    *,
    unknowns: Unknowns | None = None,  # the priors of the bound; default: `Unknowns.population()`
    # deviations of units from the nominal rig, which the estimators know; for the first `UNIT_PEOPLE`
    tolerances: Tolerances | None = None,
    overwrite: bool = False,  # replace the contents of the folder
    progress: Progress | None = None,  # called with (people done, people in all, what)
) -> dict[str, Any]:
    """Evaluate a scene's rig over a population; write report.html, summary.json, people.csv and gaze.csv into a folder.

    Raises:
        InputError: the folder is not empty, no drawn eye is physically possible, or a tolerance is that of no part.
    """
    scene.refuse_lenses("rigs are reported on", population)
    whole, scene = scene, scene.of_first_eye()
    survey = survey_of(scene, population, size, unknowns)
    own = None if tolerances is None else of_this_eye(whole, tolerances)
    noise = sensor_noise(scene)
    with staged(output, overwrite=overwrite) as folder:
        found = figures_of_people(survey, noise, size.people, workers=size.workers, progress=progress)
        if not len(found.subject):
            raise InputError("no eye of this population is physically possible", source="--population")
        biases = estimator_errors(survey, found.subject[: size.sample].tolist(), progress)
        pictured = estimator_errors(
            survey, found.subject[: size.images].tolist(), progress, images=True, backend=size.backend
        )
        slipped = figures_of_shifts(survey, noise, min(_SLIPPING, size.people), workers=size.workers)
        data = summary(scene, survey, found, biases, noise, whole.rig)
        data["estimators_on_images"] = _errors_of(pictured)
        data["slippage"] = _slippage_of(*slipped)
        data |= {"tolerances": None, "units": None}
        if tolerances is not None and own is not None:
            weights = FeatureNoise.of(OUTLINE_PX, GLINT_PX, rig=scene.rig)  # those of `MaximumLikelihood`
            data |= tolerated(survey, tolerances, own, weights, min(UNIT_PEOPLE, size.people))
        write_json(folder / SUMMARY, data)
        write_text(folder / PEOPLE, _people_csv(found))
        write_text(folder / GAZE, _gaze_csv(survey, found))
        write_page(folder / REPORT, page_of(scene, survey, found, data))
    return data


def survey_of(scene: Scene, population: Population, size: RigSize, unknowns: Unknowns | None = None) -> RigPopulation:
    """Return the rig of a scene and the people in front of it, with the priors of a population by default."""
    return RigPopulation(
        scene=scene.located().to_mapping(),
        population=population.to_mapping(),
        seed=size.seed,
        azimuth_deg=size.azimuth_deg,
        elevation_deg=size.elevation_deg,
        slippage_mm=size.slippage_mm,
        relief_mm=size.relief_mm,
        luminance_cd_m2=size.luminance,
        unknowns=(Unknowns.population() if unknowns is None else unknowns).to_mapping(),
    )


def estimator_errors(
    survey: RigPopulation,  # the rig and the people
    subjects: Sequence[int],  # numbers of the people
    progress: Progress | None = None,  # called with (people done, people in all, what)
    *,
    images: bool = False,  # use extracted features of rendered images of 25 targets, instead of exact features of 81
    backend: BackendChoice = "auto",  # the render backend for these images
) -> list[Bias]:
    """Compute gaze errors of the estimators for some people, calibrated on nine targets a metre away."""
    cells = np.array([GRID * r + c for r in range(0, GRID, 2) for c in range(0, GRID, 2)])
    cells = cells if images else np.arange(GRID * GRID)
    chosen = np.flatnonzero(np.isin(cells, CALIBRATION_CELLS))
    errors = {name: np.full((len(subjects), len(cells)), np.nan) for name in ESTIMATORS}
    reasons = dict.fromkeys(ESTIMATORS, "")
    for k, subject in enumerate(subjects):
        scene = _scene_of(survey, subject, cells)
        seen = ImageObserver(backend=backend).observe(scene.frames()) if images else trace(scene, boundary_points=30)
        for name in ESTIMATORS:
            try:
                fitted = choose_estimator(name).fit(seen.take(np.isin(seen.index.fixation, chosen)), scene.rig)
                rays = fitted.predict_rays(seen, scene.rig)  # type: ignore[attr-defined]
            except (InputError, np.linalg.LinAlgError) as error:
                reasons[name] = str(error) or "the targets do not determine it"
                continue
            for camera in range(len(scene.rig.cameras)):
                rows = np.flatnonzero(seen.index.camera == camera)
                found = ray_errors_deg(seen.take(rows), _taken(rays, rows))
                errors[name][k, seen.index.fixation[rows]] = np.fmin(errors[name][k, seen.index.fixation[rows]], found)
        notify(progress, k + 1, len(subjects), "people, " + ("images" if images else "estimators"))
    for name, found in errors.items():
        without = float(np.isnan(found).mean(axis=1).max(initial=0.0))
        if not reasons[name] and without > 0.05:
            reasons[name] = (
                f"no estimate in up to {100 * without:.0f} % of a person's directions, where features are missing"
            )
    return [Bias(name=name, error_deg=errors[name], reason=reasons[name]) for name in ESTIMATORS]


def _taken(rays: Any, rows: Any) -> Any:
    return type(rays)(rays.origin_mm[rows], rays.direction[rows], rays.reason[rows])


def _scene_of(survey: RigPopulation, subject: int, cells: Ints) -> Scene:
    """Build the scene of a person who looks at targets a metre away in the directions `cells` of the 81."""
    spec = SceneSpec.from_mapping(survey.scene)
    person = Population.from_mapping(survey.population).person(subject, survey.seed)
    base = Scene.of(spec)
    side = spec.subject.eyes[0]
    place = place_of(survey, base, person)
    half = person.apex_distance_mm / 2.0
    head = place - np.array([0.0, half if side == "left" else -half, 0.0])
    azimuth, elevation = np.radians(survey.directions_deg[cells]).T
    way = direction_of(azimuth, elevation)
    own = Subject.of(
        person, eyes=(side,), head_positions_mm=(tuple(head.tolist()),), luminance_cd_m2=survey.luminance_cd_m2
    )
    return Scene(
        own, fitted(base, person).spec.rig, targets=Targets.at(place + _TARGET_MM * way),
        wavelength_nm=spec.wavelength_nm, sensor=spec.sensor, lens=spec.lens, ambient=spec.ambient, image=spec.image,
    )  # fmt: skip


def summary(
    scene: Scene, survey: RigPopulation, found: Figures, biases: Sequence[Bias], noise: FeatureNoise, whole: RigGeometry
) -> dict[str, Any]:
    """Return the content of summary.json; all LEDs of the `whole` rig count for eye safety."""
    side = scene.spec.subject.eyes[0]
    place = scene.eye_position_mm(side) + np.array(scene.spec.subject.head_positions_mm[0])
    try:
        safety: dict[str, Any] = eye_exposure(whole, place, wavelength_nm=scene.spec.wavelength_nm).to_mapping()
    except InputError as error:
        safety = {"note": NOTE, "reason": str(error)}
    lights, extracted = len(scene.rig.lights) * len(scene.rig.cameras), extracted_noise(scene)
    seen = covered(found, min(2, len(scene.rig.lights)))
    return {
        "schema": SCHEMA,
        "scene": scene.name,
        "people": len(found.subject),
        "refused": found.refused.tolist(),
        "directions": GRID * GRID,
        "seed": survey.seed,
        "eye_box": {**eye_box_of(survey), "safety_mm": list(BOX_MM)},
        "unknowns": dict(survey.unknowns),
        "noise": {
            "outline_px": [finite_or_none(v) for v in noise.outline_px],
            "glint_px": [[finite_or_none(v) for v in row] for row in noise.glint_px],
            "extracted_outline_px": [finite_or_none(v) for v in extracted.outline_px],
            "extracted_glint_px": [[finite_or_none(v) for v in row] for row in extracted.glint_px],
        },
        "bound_deg": {"note": NOISE_ONLY, **gaze_of(found.bound_deg, seen)},
        "bound_with_fixation_deg": {
            "note": NOISE_ONLY, "fixation_deg": FIXATION_DEG, **gaze_of(found.fixating_deg, seen)
        },
        "frame_to_frame_deg": {"note": NOISE_ONLY, **gaze_of(found.noise_deg, seen)},
        "coverage": coverage_of(found),
        "glints_missing": {
            name: float(found.lost[..., k].mean() / max(lights, 1)) for k, name in enumerate(LOST)
        },
        "estimators": _errors_of(biases),
        "safety": safety,
    }  # fmt: skip


def _errors_of(biases: Sequence[Bias]) -> dict[str, Any]:
    return {
        bias.name: {**users_of(bias.error_deg), "people": len(bias.error_deg), "reason": bias.reason or None}
        for bias in biases
    }


def _slippage_of(shifts_mm: Floats, found: Sequence[Figures]) -> list[dict[str, Any]]:
    """Compute noise and coverage at each shift of the eye."""
    return [
        {
            "shift_mm": shift.tolist(),
            "noise_deg": gaze_of(figures.noise_deg, covered(figures))["median"],
            "covered_2_glints": coverage_of(figures)["outline_and_2_glints"],
        }
        for shift, figures in zip(shifts_mm, found, strict=True)
    ]


def _people_csv(found: Figures) -> str:
    """Format one row per person."""
    header = ["subject", "bound_e95_deg", "frame_to_frame_e95_deg", "outline", "glints", "covered_2_glints"]
    e95 = [np.quantile(v, 0.95, axis=1, method="higher") for v in (found.bound_deg, found.noise_deg)]
    means = [v.mean(axis=1) for v in (found.outline, found.glints, covered(found))]
    return csv_text(header, _cells(np.stack([*e95, *means], axis=1), found.subject))


def _gaze_csv(survey: RigPopulation, found: Figures) -> str:
    """Format one row per direction."""
    header = ["azimuth_deg", "elevation_deg", "bound_deg", "frame_to_frame_deg", "outline", "glints"]
    figures = [np.median(v, axis=0) for v in (found.bound_deg, found.noise_deg)]
    figures += [found.outline.mean(axis=0), found.glints.mean(axis=0), *found.lost.mean(axis=0).T]
    rows = np.column_stack([survey.directions_deg, *figures])
    return csv_text([*header, *(f"glints_missing_{name}" for name in LOST)], _cells(rows))


def _cells(rows: Floats, *first: Any) -> list[list[Any]]:
    """Format numbers (n, m), after the values of columns that come first."""
    return [[*(column[k] for column in first), *(f"{v:.6g}" for v in row)] for k, row in enumerate(rows)]


def page_of(scene: Scene, survey: RigPopulation, found: Figures, data: dict[str, Any]) -> Page:
    """Compose the report's page."""
    share, cornea = data["coverage"]["outline_and_2_glints"], data["safety"].get("cornea_share")
    cards = [
        Card(f"{100 * share:.1f} %", "of people and directions with two glints and 60 % of the outline"),
        Card(degrees_text(data["frame_to_frame_deg"]["U50E95"]), "noise of gaze, median person (U50E95, noise only)"),
        Card(degrees_text(data["bound_deg"]["U95E95"]),
             "after a calibration, 95th-percentile person (U95E95, noise only)"),
        Card("not known" if cornea is None else f"{100 * cornea:.1f} %",
             f"of the corneal limit ({NOTE}); " + ("" if cornea is None else f"{_stuck(data)} with LEDs stuck on")),
    ]  # fmt: skip
    sections = (
        _cost_section(data), _gaze_section(survey, found), _who_section(survey, found, data), _slippage_section(data),
        _bias_section(data), _safety_section(data),
    )  # fmt: skip
    lead = [
        _answer(data),
        f"{data['people']} people look in {GRID * GRID} directions in front of the rig of '{scene.name}'. "
        f"{eye_box_text(data['eye_box'])} Everything but errors on images is ray optics.",
        "The bound is the smallest error that any unbiased estimator can have with these features. It counts noise "
        "alone. What an estimator assumes wrongly about the eye comes on top. U50E95 and U95E95 are the median and the "
        "95th-percentile person's 95th-percentile error over the directions that the rig covers.",
    ]
    return Page(f"Rig report: {scene.name}", lead, cards, sections)


def _answer(data: dict[str, Any]) -> str:
    """Say in a few sentences how good the rig is."""
    share, bound, noise = data["coverage"]["outline_and_2_glints"], data["bound_deg"], data["frame_to_frame_deg"]
    fixating = data["bound_with_fixation_deg"]
    parts = [f"In short: the rig sees two glints and 60 % of the pupil's outline in {100 * share:.1f} % of all cases."]
    if noise["U50E95"] is None:
        parts.append("For the median person, the features do not determine gaze in every direction.")
    else:
        parts.append(f"The sensor's noise moves the gaze of the median person by {degrees_text(noise['U50E95'])}.")
    if bound["U50E95"] is not None:
        parts.append(
            "After a calibration on nine targets that are fixated exactly the bound is "
            f"{degrees_text(bound['U50E95'])}; with a fixation noise of {FIXATION_DEG}° per axis it is "
            f"{degrees_text(fixating['U50E95'])}."
        )
    known = {name: one["U50E95"] for name, one in data["estimators"].items() if one["U50E95"] is not None}
    if known:
        best = min(known, key=lambda name: known[name])
        parts.append(f"The best estimator, {best}, has model errors of {degrees_text(known[best])}.")
    return " ".join(parts)


def _cost_section(data: dict[str, Any]) -> Section:
    """Write one table of the costs of noise, of tolerances, and of wrong assumptions of estimators."""
    people = str(data["people"])
    rows = [
        ["noise between frames", degrees_text(data["frame_to_frame_deg"]["median"]), people],
        ["noise, after a calibration with exact fixation", degrees_text(data["bound_deg"]["median"]), people],
        ["noise, with that of fixation", degrees_text(data["bound_with_fixation_deg"]["median"]), people],
    ]
    for one in data["tolerances"] or ():
        kind, (quantity, unit) = one["part"].replace("led", "LED"), one["quantity"].rsplit("_", 1)
        part = f"every {kind}" if one["number"] == "all" else f"{kind} {one['number']}"
        size = f"{quantity.replace('_', ' ')} {one['sd']:g} {unit.replace('percent', '%')}"
        what = f"{part}: {size}, {one['when']} the calibration"
        rows.append([what, degrees_text(one["gaze_deg"]), str(data["units"]["people"])])
    if data["units"] is not None:
        units = data["units"]
        text = f"U50E95 {degrees_text(units['U50E95'])}, U95E95 {degrees_text(units['U95E95'])}"
        rows.append([f"all tolerances, {units['units']} drawn units for each person", text, str(units["people"])])
    for name, one in data["estimators"].items():
        if one["U50E95"] is not None:
            rows.append([f"{name}, on exact features", f"U50E95 {degrees_text(one['U50E95'])}", str(one["people"])])
    caption = (
        "Standard deviations of the direction of gaze (median over people and directions) where nothing else is said."
    )
    return Section("What costs how much?", Table(["cause", "gaze", "people"], rows, caption=caption, wide=(0,)))


def _gaze_section(survey: RigPopulation, found: Figures) -> Section:
    seen = covered(found)
    most = max(int(found.glints.max()), 1)
    maps = (
        ("noise of gaze (median, deg; noise only)", np.median(found.noise_deg, axis=0), (None, None)),
        ("visible glints (mean)", found.glints.mean(axis=0), (0, most)),
        ("visible share of the outline (mean)", found.outline.mean(axis=0), (0, 1)),
        ("people with 2 glints and 60 % of the outline", seen.mean(axis=0), (0, 1)),
    )  # fmt: skip
    a, e = survey.azimuth_deg, survey.elevation_deg
    drawn = []
    for title, values, ends in maps:
        grid = np.where(np.isfinite(values), values, np.nan).reshape(GRID, GRID)
        drawing = heat_map(grid, (-a, a, -e, e), ("azimuth to the left (deg)", "elevation (deg)"), ends=ends)
        drawn.append(
            Figure(drawing, f"{title[0].upper()}{title[1:]}, over azimuth and elevation of the optic axis.", True)
        )
    return Section("Where does the rig see well?", *drawn)


def _who_section(survey: RigPopulation, found: Figures, data: dict[str, Any]) -> Section:
    seen = covered(found).mean(axis=1)
    noise = np.quantile(found.noise_deg, 0.95, axis=1, method="higher")
    worst = np.lexsort((-noise, seen))[:10]
    population = Population.from_mapping(survey.population)
    rows = [
        [str(found.subject[k]), f"{100 * seen[k]:.0f} %", f"{found.glints[k].mean():.1f}",
         f"{100 * found.outline[k].mean():.0f} %", degrees_text(finite_or_none(noise[k])),
         *_traits_as_text(population.person(int(found.subject[k]), survey.seed))]
        for k in worst
    ]  # fmt: skip
    shares = data["coverage"]
    coverage = [
        ["60 % of the outline", f"{100 * shares['outline']:.1f} %"],
        *([f"and at least {k} glints", f"{100 * shares[f'outline_and_{k}_glints']:.1f} %"] for k in (1, 2, 3)),
    ]
    why = {
        "ray": "no ray: the mirror point is off the cornea",
        "sensor": "off the sensor",
        "lid": "behind a lid, for the camera or the LED",
        "lash": f"behind lashes: less than {100 * LEAST_SHARE:.0f} % of the glint is left",
        "obstacle": "behind an obstacle, for the camera or the LED",
        "opening": "outside an opening of the lens",
    }
    missing = [[why[name], f"{100 * share:.1f} %"] for name, share in data["glints_missing"].items()]
    tables = [
        Table(["visible", "people x directions"], coverage, caption="Coverage."),
        Table(["reason", "glints"], missing, caption="Why glints are missing."),
        Table(["person", "covered", "glints", "outline", "noise, 95th percentile", *TRAITS], rows,
              caption="The ten people for whom the rig covers least; those with the same coverage by their noise."),
    ]  # fmt: skip
    return Section("For whom does it fail?", *tables)


def traits_of(person: Person) -> tuple[float, float, float, float]:
    """Return a person's `TRAITS`."""
    fissure = person.region().fissure
    return person.number("age_years"), fissure.upper_mm + fissure.lower_mm, fissure.width_mm, person.ipd_mm


def _traits_as_text(person: Person) -> list[str]:
    age, *lengths = traits_of(person)
    return [f"{age:.0f}", *(f"{length:.1f}" for length in lengths)]


def _slippage_section(data: dict[str, Any]) -> Section:
    rows = data["slippage"]
    plane, away = rows[: len(SHIFTS_MM) ** 2], rows[len(SHIFTS_MM) ** 2 :]
    drawn = []
    for key, title, ends in (
        ("noise_deg", "noise of gaze (median, deg)", (None, None)),
        ("covered_2_glints", "share of directions with two glints and 60 % of the outline", (0, 1)),
    ):
        values = np.array([np.nan if row[key] is None else row[key] for row in plane]).reshape(2 * (len(SHIFTS_MM),))
        drawing = heat_map(values, (-3.75, 3.75, -3.75, 3.75), ("eye to the left (mm)", "eye up (mm)"), ends=ends)
        drawn.append(Figure(drawing, f"{title[0].upper()}{title[1:]}, over the place of the eye.", True))
    table = [
        [f"{row['shift_mm'][0]:+.1f} mm", degrees_text(row["noise_deg"]), f"{100 * row['covered_2_glints']:.1f} %"]
        for row in away
    ]
    text = f"The first {_SLIPPING} people in all directions, with the eye shifted against the rig."
    head = ["nearer by", "noise", "covered"]
    return Section("What does slippage do?", text, *drawn, Table(head, table))


def _bias_section(data: dict[str, Any]) -> Section:
    tables = []
    for key, what in (("estimators", "exact features"), ("estimators_on_images", "rendered images of 25 targets")):
        rows = [
            [name, degrees_text(v["U50E95"]) if v["U50E95"] is not None else "—",
             degrees_text(v["U95E95"]) if v["U95E95"] is not None else "—", v["reason"] or ""]
            for name, v in data[key].items()
        ]  # fmt: skip
        count = max((v["people"] for v in data[key].values()), default=0)
        if count:
            columns = 4 if any(row[3] for row in rows) else 3
            caption = f"Errors on {what}, {count} {'person' if count == 1 else 'people'}."
            head = ["estimator", "U50E95", "U95E95", "note"][:columns]
            tables.append(Table(head, [row[:columns] for row in rows], caption=caption, wide=(3,)))
    text = (
        "Estimators that need no screen, each calibrated on nine targets. Errors on exact features have no noise: this "
        "is what each estimator assumes wrongly about the eye. Errors on rendered images add noise, lids, lashes and "
        "the extractor. With few people, U50E95 and U95E95 are almost the same."
    )
    return Section("What do estimators add?", text, *tables)


def _stuck(data: dict[str, Any]) -> str:
    return f"{100 * data['safety']['stuck_on']['cornea_share']:.1f} %"


def _safety_section(data: dict[str, Any]) -> Section:
    safety = data["safety"]
    if "lights" not in safety:
        return Section("Eye safety", f"{safety['reason']}. This is {NOTE}.")
    rows = []
    for light in safety["lights"]:
        retina = light["retina"]
        known = retina if isinstance(retina, str) else f"{100 * retina['share']:.2g} % of its limit"
        rows.append([str(light["light"]), f"{light['distance_mm']:.1f}", f"{light['cornea_w_m2']:.3g}", known])
    text = (
        f"All LEDs together: {safety['cornea_w_m2']:.3g} W/m² at the cornea, limit "
        f"{safety['cornea_limit_w_m2']:g} W/m² (IEC 62471, ICNIRP 2013; long exposure), each at the worst place of an "
        f"eye box of 3 mm about the eye. If a fault leaves the LEDs on, they reach {_stuck(data)} of the limit. "
        f"This is {NOTE}."
    )
    head = ["LED", "distance (mm)", "cornea (W/m²)", "retina"]
    return Section("Eye safety", text, Table(head, rows, wide=(3,)))
