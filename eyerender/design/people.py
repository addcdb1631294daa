"""A rig in front of a population: the bound for each person and direction of gaze, and the features that cameras see.

Every person is calibrated at nine of the directions. The information about the person from there,

    S = P^-1 + sum over the calibration of  C - B^T A^-1 B                                                        (7)

with the blocks A (frame), B and C (person) of each frame's information and its prior, is added to the information of
every other single frame. The bound is that of the line of sight. Points of the outline and glints count if a ray
reaches the camera, they lie on the sensor, and lids and lashes leave the ray free: it passes between the lids' margins,
which are as thick as those of the rendered lids, and the lashes' curves, which are the rendered ones where no skin
bends them. For a glint this holds for the light's way from the LED too. Obstacles of the rig and openings of the lens
hide features as they do for the analytic observer. Frames of spectacles are ignored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..analytic.features import View
from ..analytic.occluders import Occluders
from ..analytic.rays import glint_exits, pupil_exits
from ..base.arrays import ArrayValue, Bools, Floats, Indices, Ints
from ..base.errors import InputError
from ..base.status import Status
from ..eye.batch import structure_of, take_eyes
from ..eye.model import EyeModel
from ..eye.pose import Poses
from ..population.people import Person
from ..region.anatomy import Region
from ..rig.camera import PinholeCamera
from ..rig.rig import RigGeometry
from ..scene import Scene
from ..scene.people import Population
from ..scene.spec import SceneSpec
from .choice import SiteInformation, joined, site_matrices, with_priors
from .information import Case, information_of_views, target_information
from .lids import Lids, visible
from .noise import FeatureNoise
from .unknowns import AZIMUTH, COUNT, ELEVATION, LOCAL, PUPIL, Unknowns
from .varied import FeatureSlopes, Views, diameters_mm, gaze_slopes, slopes_of, stacked_eyes

POINTS = 16
GRID = 9
CALIBRATION = (0, 4, 8)
"""Rows and columns of the 9 x 9 directions that calibrate."""
CALIBRATION_CELLS = np.array([GRID * r + c for r in CALIBRATION for c in CALIBRATION])
"""Indices of the calibration directions among all 81."""
TOGETHER = 8
_VAGUE, _LOST_DEG = 1e3, 60.0
_EXACT_DEG = 1e-3  # noise of a fixation that adds nothing to the bound
LOST = ("ray", "sensor", "lid", "lash", "obstacle", "opening")
"""Reasons for a missing glint: no ray (off the cornea), off the sensor, behind lid, lashes, obstacle or opening."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigPopulation:
    """A rig and the population in front of it."""

    scene: Mapping[str, Any]  # mapping of the scene; only its first eye, first head position, rig and sensor are used
    population: Mapping[str, Any]  # mapping of the population
    seed: int = 0  # seed of the people
    azimuth_deg: float = 20.0  # half range of the optic axis' azimuth
    elevation_deg: float = 15.0  # half range of its elevation
    slippage_mm: float = 1.5  # standard deviation of the eye's position about the scene's, along each axis
    luminance_cd_m2: float = 20.0  # luminance of what people see, which sets their pupils
    unknowns: Mapping[str, Any]  # mapping of `Unknowns`: what is known beforehand
    lids: bool = True  # whether lids and lashes hide features
    relief_mm: float = 0.0  # additional standard deviation of the eye relief, the distance along x
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # common shift of all positions, for maps of slippage

    @property
    def directions_deg(self) -> Floats:
        """Azimuth and elevation (81, 2) of the optic axis, row by row from the top."""
        elevation = np.linspace(self.elevation_deg, -self.elevation_deg, GRID)
        azimuth = np.linspace(-self.azimuth_deg, self.azimuth_deg, GRID)
        return np.array([[a, e] for e in elevation for a in azimuth])

    @property
    def occluders(self) -> Occluders | None:
        """Obstacles of the rig and openings of the lens; None if there are none."""
        scene = Scene.of(SceneSpec.from_mapping(self.scene))
        return Occluders.of(scene.rig, scene.openings)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Figures(ArrayValue):
    """Figures of p people in 81 directions."""

    subject: Ints  # (p,) number of the person
    # (p, 81) standard deviation of the line of sight after a calibration on targets that are fixated exactly; inf if
    # undetermined
    bound_deg: Floats
    fixating_deg: Floats  # (p, 81) the same with the noise of fixation during the calibration
    noise_deg: Floats  # (p, 81) the same for an exactly known person: the part that differs between frames
    outline: Floats  # (p, 81) visible share of the outline, in the camera that sees most
    glints: Ints  # (p, 81) number of lights whose glint is visible in any camera
    lost: Ints  # (p, 81, 6) glints (of any camera) that are missing for the reasons `LOST`
    refused: Ints  # numbers of people whose eye is physically impossible

    @classmethod
    def joined(cls, parts: list[Figures]) -> Figures:
        """Join figures of different people."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__})


@dataclass(frozen=True, slots=True, kw_only=True)
class Someone:
    """A person in front of the rig: eye, lids, position of the apex, and the scene with the rig set to this person."""

    subject: int
    scene: Scene
    eye: EyeModel
    region: Region
    place_mm: Floats


def people_of(survey: RigPopulation, first: int, count: int) -> tuple[list[Someone], list[int]]:
    """Draw people; return those with a possible eye, and the numbers of the others.

    A person depends on the seed and the number alone. The distance of the pupils moves the eye against the rig.
    """
    scene = Scene.of(SceneSpec.from_mapping(survey.scene))
    side = scene.spec.subject.eyes[0]
    drawn = Population.from_mapping(survey.population).draw(count, survey.seed, first=first)
    found, refused = [], []
    for row in range(count):
        person = drawn.person(row)
        try:
            spec = person.eye(side, luminance_cd_m2=survey.luminance_cd_m2)
            eye = spec.build(eye=side, wavelength_nm=scene.spec.wavelength_nm)
        except InputError:
            refused.append(person.subject)
            continue
        found.append(
            Someone(
                subject=person.subject,
                scene=fitted(scene, person),
                eye=eye,
                region=person.region(),
                place_mm=place_of(survey, scene, person),
            )
        )
    return found, refused


def fitted(scene: Scene, person: Person) -> Scene:
    """Return the scene with its rig set to a person's distance of the pupils; the scene itself if it has no setting."""
    rig = scene.spec.rig.set_to(person.ipd_mm)
    return scene if rig is scene.spec.rig else scene.replaced(scene.spec.model_copy(update={"rig": rig}))


def place_of(survey: RigPopulation, scene: Scene, person: Person) -> Floats:
    """Compute the apex (3,) mm of a person's unrotated eye in the world.

    It is that of the scene, moved by half the difference in interpupillary distance, by a random slippage, and by what
    remains after the rig is set to the distance.
    """
    side = scene.spec.subject.eyes[0]
    place = scene.eye_position_mm(side) + np.array(scene.spec.subject.head_positions_mm[0])
    half = (person.ipd_mm - scene.spec.subject.ipd_mm) / 2.0
    rng = np.random.default_rng((survey.seed, person.subject, 0x51))
    shift = survey.slippage_mm * rng.standard_normal(3)
    shift[0] += survey.relief_mm * rng.standard_normal()
    if (adjust := scene.spec.rig.ipd_adjust) is not None:
        shift[1] += adjust.residual_mm * rng.standard_normal()
    shift += survey.shift_mm
    return np.asarray(place + shift + np.array([0.0, half if side == "left" else -half, 0.0]))


def figures_of(survey: RigPopulation, noise: FeatureNoise, first: int, count: int) -> Figures:
    """Compute the figures of some people."""
    everyone, refused = people_of(survey, first, count)
    groups = _groups(everyone)
    return Figures.joined([_nobody(refused), *(_of_group(survey, noise, some) for some in groups)])


def _groups(everyone: Sequence[Someone]) -> Iterator[list[Someone]]:
    """Yield people before one rig whose eyes can be stacked, a few at a time."""
    kinds: dict[object, list[Someone]] = {}
    for one in everyone:
        kinds.setdefault((structure_of(one.eye), id(one.scene)), []).append(one)
    for same in kinds.values():
        for start in range(0, len(same), TOGETHER):
            yield same[start : start + TOGETHER]


def cases_of(survey: RigPopulation, count: int) -> Iterator[tuple[Case, Lids | None]]:
    """Yield cases of the first people, a few people in each, and the lids about their eyes."""
    return ((case, lids) for _, case, lids in surveyed(survey, count))


def surveyed(survey: RigPopulation, count: int) -> Iterator[tuple[Scene, Case, Lids | None]]:
    """Yield the same with the scene whose rig is set to these people."""
    for some in _groups(people_of(survey, 0, count)[0]):
        scene = some[0].scene
        yield scene, _case(survey, scene.rig, some), lids_of(survey, some)


def sites_seen(survey: RigPopulation, noises: Sequence[FeatureNoise], count: int) -> list[SiteInformation]:
    """Compute the information that each LED adds for the first people with an eye, in the nine calibration directions.

    All rays are traced once, for any number of `noises`; the result has one item for each.
    """
    unknowns, people = Unknowns.from_mapping(survey.unknowns), people_of(survey, 0, count)[0]
    occluders = survey.occluders
    if not people:
        raise InputError("no eye of this population is physically possible", path="population")
    parts: list[list[SiteInformation]] = [[] for _ in noises]
    for one in people:
        rig = one.scene.rig
        case = _case(survey, rig, [one])
        instants, theta = case.instants.take(CALIBRATION_CELLS), case.theta[CALIBRATION_CELLS]
        lids = lids_of(survey, [one])
        lids = None if lids is None else lids.take(CALIBRATION_CELLS)
        numbers = [np.full(len(CALIBRATION_CELLS), number) for number in range(len(rig.cameras))]
        seen = [
            seen_features(replace(instants, camera=number), theta, camera, (lids, occluders))[0]
            for number, camera in zip(numbers, rig.cameras, strict=True)
        ]
        for part, noise in zip(parts, noises, strict=True):
            found = [site_matrices(slopes, noise, number) for slopes, number in zip(seen, numbers, strict=True)]
            bases, sites = zip(*found, strict=True)
            part.append(with_priors(np.sum(bases, axis=0), np.sum(sites, axis=0), unknowns))
    return [joined(part) for part in parts]


def seen_features(
    views: Views,
    theta: Floats,
    camera: PinholeCamera,
    hidden_by: tuple[Lids | None, Occluders | None],
    free: Bools | None = None,
) -> tuple[FeatureSlopes, Ints]:
    """Trace the features of the views of one camera, and remove those that are hidden.

    `hidden_by` are the lids of the views, and what else hides features. Returns the features that are left, and the
    numbers (n, 6) of glints lost by reason (`LOST`).
    """
    lids, occluders = hidden_by
    slopes = slopes_of(views, theta, POINTS, free)
    outline, mirror = surface_points(views, theta)
    left, why = visible(slopes, views, camera, lids, (outline, mirror))
    on_outline, of_glints = (np.zeros(ok.shape, np.int8) for ok in (left.outline_ok, left.glint_ok))
    if occluders is not None:
        occluders.mark(on_outline, slopes.images.outline_px.copy(), outline, camera, None)
        occluders.mark(of_glints, slopes.images.glints_px.copy(), mirror, camera, views.lights_mm)
    reasons = (Status.BEHIND_OBSTACLE, Status.BEHIND_OPENING)
    lost = [np.count_nonzero(left.glint_ok & (of_glints == reason), axis=1) for reason in reasons]
    shown = (left.outline_ok & (on_outline == Status.OK), left.glint_ok & (of_glints == Status.OK))
    return replace(left, outline_ok=shown[0], glint_ok=shown[1]), np.column_stack([why, *lost])


def surface_points(views: Views, theta: Floats) -> tuple[Floats, Floats]:
    """Compute where outline (n, k, 3) and glints (n, m, 3) are seen on the cornea, in the world; NaN without a ray."""
    eye = take_eyes(views.eyes, views.person)
    camera = views.rig.cameras[int(views.camera[0])]
    view = View.of(eye, Poses.listing(theta[:, AZIMUTH], theta[:, ELEVATION]), views.position_mm, camera)
    outline, _, seen = pupil_exits(eye, POINTS, view.camera_mm)
    glints, _, mirrored = glint_exits(eye, 1, view.into_eye(views.lights_mm), view.camera_mm)
    rays = (outline, seen), (glints, mirrored)
    points = [np.where((status == Status.OK)[..., None], view.in_world(exits), np.nan) for exits, status in rays]
    return points[0][:, :-1], points[1]


def _nobody(refused: list[int]) -> Figures:
    cells = GRID * GRID
    return Figures(
        subject=np.empty(0, np.int64),
        bound_deg=np.empty((0, cells)),
        fixating_deg=np.empty((0, cells)),
        noise_deg=np.empty((0, cells)),
        outline=np.empty((0, cells)),
        glints=np.empty((0, cells), np.int64),
        lost=np.empty((0, cells, len(LOST)), np.int64),
        refused=np.array(refused, dtype=np.int64),
    )


def _of_group(survey: RigPopulation, noise: FeatureNoise, people: list[Someone]) -> Figures:
    """Compute figures of a few people at once, camera by camera."""
    rig = people[0].scene.rig
    case = _case(survey, rig, people)
    i, m = len(case.theta), len(rig.lights)
    matrices, outline = np.zeros((i, COUNT, COUNT)), np.zeros(i)
    glints, lost = np.zeros((i, m), dtype=bool), np.zeros((i, len(LOST)), dtype=np.int64)
    hidden_by = lids_of(survey, people), survey.occluders
    free = Unknowns.from_mapping(survey.unknowns).free()
    for number, camera in enumerate(rig.cameras):
        views = replace(case.instants, camera=np.full(i, number))
        slopes, why = seen_features(views, case.theta, camera, hidden_by, free)
        matrices += information_of_views(slopes, noise, views.camera)
        outline = np.maximum(outline, slopes.outline_ok.mean(axis=1))
        glints |= slopes.glint_ok
        lost += why
    cells = GRID * GRID
    unknowns = Unknowns.from_mapping(survey.unknowns)
    bound, alone = bounds(case, matrices, replace(noise, fixation_deg=_EXACT_DEG), unknowns)
    fixating, _ = bounds(case, matrices, noise, unknowns)
    return Figures(
        subject=np.array([one.subject for one in people]),
        bound_deg=bound.reshape(-1, cells),
        fixating_deg=fixating.reshape(-1, cells),
        noise_deg=alone.reshape(-1, cells),
        outline=outline.reshape(-1, cells),
        glints=glints.sum(axis=1).reshape(-1, cells),
        lost=lost.reshape(-1, cells, len(LOST)),
        refused=np.empty(0, np.int64),
    )


def _case(survey: RigPopulation, rig: RigGeometry, people: list[Someone]) -> Case:
    """Create a case of all directions of some people, one instant each; the camera is set later."""
    eyes = stacked_eyes([one.eye for one in people])
    cells = GRID * GRID
    person = np.repeat(np.arange(len(people)), cells)
    theta = np.zeros((len(person), COUNT))
    theta[:, [AZIMUTH, ELEVATION]] = np.radians(np.tile(survey.directions_deg, (len(people), 1)))
    theta[:, PUPIL] = diameters_mm(eyes)[person]
    places = np.array([one.place_mm for one in people])[person]
    views = Views(eyes=eyes, person=person, position_mm=places, camera=np.zeros(len(person), np.int64), rig=rig)
    nowhere = np.full((len(person), 3), np.nan)
    return Case(views=views, instant=np.arange(len(person)), instants=views, theta=theta, target_mm=nowhere)


def lids_of(survey: RigPopulation, people: Sequence[Someone]) -> Lids | None:
    """Compute the lids about people's eyes in all directions; None if they hide nothing."""
    grid = survey.directions_deg.reshape(GRID, GRID, 2)
    return Lids.joined([Lids.of(one.region, one.eye, one.place_mm, grid) for one in people]) if survey.lids else None


def bounds(case: Case, matrices: Floats, noise: FeatureNoise, unknowns: Unknowns) -> tuple[Floats, Floats]:
    """Compute the standard deviation (i,) deg of the line of sight after each person's calibration, equation (7).

    The second result is that of an exactly known person.
    """
    found = learned(case, matrices, noise, unknowns)
    own = slice(0, found.frame)
    slopes = gaze_slopes(case.instants, case.theta)[:, :, found.every]
    return _deviation_deg(found.joint, slopes), _deviation_deg(found.joint[:, own, own], slopes[:, :, own])


@dataclass(frozen=True, slots=True, kw_only=True)
class Learned:
    """Information after each person's calibration."""

    every: Indices  # (u,) numbers of the free unknowns, first those of a frame, then those of the person
    frame: int  # how many of them are a frame's
    joint: Floats  # (i, u, u) information on them in each frame, with the calibration's on the person, equation (7)
    # the blocks A (r, f, f) and B (r, f, u - f) of the frames of the calibration, with the frame's priors
    blocks: tuple[Floats, Floats]


def learned(case: Case, matrices: Floats, noise: FeatureNoise, unknowns: Unknowns) -> Learned:
    """Calibrate each person, equation (7)."""
    free = unknowns.free()
    prior = np.maximum(unknowns.precision(), _VAGUE**-2)  # so that a frame without features has an inverse
    local, person = np.flatnonzero(free[:LOCAL]), LOCAL + np.flatnonzero(free[LOCAL:])
    every = np.concatenate([local, person])
    joint = matrices[:, every[:, None], every] + np.diag(np.where(every < LOCAL, prior[every], 0.0))
    rows = (GRID * GRID * np.arange(len(matrices) // GRID**2)[:, None] + CALIBRATION_CELLS).ravel()
    whole = matrices[rows] + target_information(case, noise, rows)
    a = whole[:, local[:, None], local] + np.diag(prior[local])
    b = whole[:, local[:, None], person]
    shared = whole[:, person[:, None], person] - np.swapaxes(b, 1, 2) @ np.linalg.solve(a, b)
    each = shared.reshape(-1, len(CALIBRATION_CELLS), len(person), len(person)).sum(axis=1)
    joint[:, len(local) :, len(local) :] += np.repeat(np.diag(prior[person]) + each, GRID * GRID, axis=0)
    return Learned(every=every, frame=len(local), joint=joint, blocks=(a, b))


def _deviation_deg(matrices: Floats, slopes: Floats) -> Floats:
    """Compute standard deviations (i,) deg of directions with derivatives (i, 2, q); inf if undetermined."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("iaa->ia", matrices), 1e-12))
    scaled = matrices * scale[:, :, None] * scale[:, None, :] + 1e-13 * np.eye(matrices.shape[1])
    slopes = slopes * scale[:, None, :]
    spread = np.einsum("nca,nac->n", slopes, np.linalg.solve(scaled, np.swapaxes(slopes, 1, 2)))
    found = np.degrees(np.sqrt(np.maximum(spread, 0.0)))
    return np.where(found < _LOST_DEG, found, np.inf)
