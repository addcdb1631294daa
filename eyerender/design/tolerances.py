"""What the deviations of a unit from its nominal rig cost: errors of gaze for an estimator that knows the nominal rig.

A deviation d (a turned camera, a displaced LED) moves the features by df = (df/dd) d. The estimator of the bound, whose
information on a frame's unknowns and the person is M, with the derivatives J and the noise W^-1, takes this for a
change of the eye and errs by

    dx = (M + S)^-1 (J^T W df + S dp),     dp = S^-1 sum over the calibration of  (g_p - B^T A^-1 g_f)             (8)

S is the information on the person after the calibration, equation (7), and dp the error of the person that the
calibration learns if the deviation was there during it (`when: before`), with g = J^T W df of each of its frames in the
parts of the frame (f) and the person (p). For deviations that come later (`after`) dp is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..base.arrays import ArrayValue, Bools, Floats, Ints, finite_or_none, frozen
from ..base.errors import InputError
from ..base.spec import FileSpec, Positive, Spec
from ..rig.camera import Camera, Mirror, PinholeCamera
from ..rig.distortion import distortion_data
from ..rig.rig import Rig, RigGeometry
from ..scene import Scene
from ..scene.observation import EYES
from ..scene.spec import SceneSpec
from .crowd import OUTLINE, users_of
from .information import Case, information_of_views, whitened_rows
from .lids import Lids
from .noise import FeatureNoise
from .people import CALIBRATION_CELLS, GRID, POINTS, RigPopulation, learned, seen_features, surveyed
from .unknowns import Unknowns
from .varied import FeatureSlopes, Views, gaze_slopes, images_of

_STEP = 0.1  # of a standard deviation, for derivatives by central differences
UNITS, UNIT_PEOPLE = 200, 20
"""Number of drawn units, and of people before them."""
_LEAST_POWER = 1e-3  # of the nominal one, so that a drawn LED is never off

_AXES = {
    ("camera", "rotation_deg"): 3,
    ("camera", "position_mm"): 3,
    ("camera", "focal_length_percent"): 1,
    ("camera", "principal_point_px"): 2,
    ("led", "position_mm"): 3,
    ("led", "power_percent"): 0,
    ("mirror", "rotation_deg"): 2,
    ("mirror", "position_mm"): 1,
}
"""Independent axes of each deviation. An LED's power moves no feature; a mirror moves along its normal."""


_MOST = {
    "rotation_deg": 10.0, "position_mm": 20.0, "focal_length_percent": 20.0, "principal_point_px": 500.0,
    "power_percent": 100.0,
}  # fmt: skip
"""Largest standard deviations (chosen), well beyond those for which errors are linear."""

Quantity = Literal["rotation_deg", "position_mm", "focal_length_percent", "principal_point_px", "power_percent"]


class Tolerance(Spec):
    """A standard deviation of one quantity, independent for each part and each axis."""

    part: Literal["camera", "led", "mirror"] = Field(description="kind of part; a mirror has the number of its camera")
    number: Annotated[int, Field(ge=0)] | Literal["all"] = Field(default="all", description="its number, or all")
    quantity: Quantity = Field(description="what deviates")
    sd: Positive = Field(description="standard deviation along each axis, in the unit of the quantity")
    when: Literal["before", "after"] = Field(
        description="before the user's calibration (assembly), which learns a part of it, or after it (heat, drops)"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.part, self.quantity) not in _AXES:
            known = [quantity for part, quantity in _AXES if part == self.part]
            raise ValueError(f"a {self.part} has {', '.join(known)}")
        if self.sd > _MOST[self.quantity]:
            raise ValueError(f"sd: must be at most {_MOST[self.quantity]:g} for {self.quantity}, not {self.sd:g}")
        return self


class Tolerances(FileSpec):
    """A file of tolerances.

    >>> er.design.Tolerances(tolerances=[{"part": "led", "quantity": "position_mm", "sd": 0.1, "when": "after"}]).format
    1
    """

    tolerances: Annotated[tuple[Tolerance, ...], Field(min_length=1, max_length=100)] = Field(description="the list")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class UnitErrors(ArrayValue):
    """Errors of gaze by the deviations of e axes, one standard deviation each, for p people in 81 directions."""

    errors_deg: Floats  # (p, 81, e, 2) to the subject's left and up
    tolerance: Ints  # (e,) the tolerance of each axis
    covered: Bools  # (p, 81) whether the rig sees two glints and enough of the outline

    def by_tolerance(self, count: int) -> list[float]:
        """Compute the standard deviation of the direction of gaze by each of `count` tolerances: median, degrees."""
        seen = self.errors_deg[self.covered]
        out = []
        for k in range(count):
            part = seen[:, self.tolerance == k]
            out.append(float(np.median(np.sqrt((part**2).sum(axis=(1, 2))))) if len(part) else float("nan"))
        return out

    def of_units(self, seed: int, units: int = UNITS) -> Floats:
        """Draw units; return the error (p x units, 81) deg of every person with every unit, NaN where not covered."""
        draws = np.random.default_rng((seed, 0x70)).standard_normal((units, self.errors_deg.shape[2]))
        vectors = np.einsum("pdec,ue->pudc", self.errors_deg, draws)
        sizes = np.where(self.covered[:, None], np.linalg.norm(vectors, axis=-1), np.nan)
        return np.asarray(sizes.reshape(-1, GRID * GRID))


def of_this_eye(scene: Scene, tolerances: Tolerances) -> Tolerances:
    """Count the parts of tolerances, whose numbers are those of the whole rig, among the parts that the first eye has.

    Raises:
        InputError: a part does not exist, or serves the other eye alone.
    """
    side, rig = scene.spec.subject.eyes[0], scene.rig
    cameras = [k for k, camera in enumerate(rig.cameras) if camera.sees(side)]
    lights = list(rig.lights_of(EYES.index(side)))
    out = []
    for k, one in enumerate(tolerances.tolerances):
        count, kept = (len(rig.lights), lights) if one.part == "led" else (len(rig.cameras), cameras)
        if one.number != "all" and one.number not in kept:
            other = f"{one.part} {one.number} serves the other eye, and the report is about the {side} one"
            reason = f"the rig has no {one.part} {one.number}" if one.number >= count else other
            raise InputError(reason, path=f"tolerances.{k}.number")
        number = one.number if one.number == "all" else kept.index(one.number)
        out.append(one.model_copy(update={"number": number}))
    own = tolerances.model_copy(update={"tolerances": tuple(out)})
    list(axes_of(scene.of_first_eye(), own))  # refuses mirrors that do not exist
    return own


def tolerated(
    survey: RigPopulation, tolerances: Tolerances, own: Tolerances, noise: FeatureNoise, people: int
) -> dict[str, Any]:
    """Compute what each tolerance costs, and the errors of drawn units; `own` counts the parts of this eye's rig.

    The estimator weights features by `noise`.
    """
    found = unit_errors(survey, own, noise, people)
    rows = tolerances.to_mapping()["tolerances"]
    costs = found.by_tolerance(len(rows))
    return {
        "tolerances": [{**row, "gaze_deg": finite_or_none(cost)} for row, cost in zip(rows, costs, strict=True)],
        "units": {"people": people, "units": UNITS, **users_of(found.of_units(survey.seed))},
    }


def drawn_unit(rig: Rig, tolerances: Tolerances, seed: Sequence[int]) -> Rig:
    """Draw a unit: a rig whose parts deviate from the nominal `rig`, whenever the deviations come about.

    Cameras have calibrations, and rings are single LEDs. Deviations are before the rig's mount, and a camera's are
    along the axes of the camera itself. Raises InputError if a number is not one of the rig's parts.
    """
    rng, rig = np.random.default_rng(seed), rig.resolved()
    cameras, leds = [camera.unmirrored() for camera in rig.cameras], rig.single_leds()
    specs = list(rig.cameras)
    for k, one in enumerate(tolerances.tolerances):
        for number in _numbers(one, k, len(leds), rig.cameras):
            amounts = one.sd * rng.standard_normal(max(_AXES[one.part, one.quantity], 1))
            if one.part == "mirror":
                for axis, amount in enumerate(amounts):
                    mirror = _moved_mirror(specs[number], one.quantity, axis, float(amount))
                    specs[number] = specs[number].model_copy(update={"mirror": mirror})
            elif one.quantity == "power_percent":
                leds[number]["intensity_mw_sr"] *= max(1.0 + float(amounts[0]) / 100.0, _LEAST_POWER)
            elif one.part == "led":
                leds[number]["position_mm"] = (np.asarray(leds[number]["position_mm"]) + amounts).tolist()
            else:
                for axis, amount in enumerate(amounts):
                    cameras[number] = _deviating(cameras[number], one.quantity, axis, float(amount))
    made = [_calibrated(spec, camera) for spec, camera in zip(specs, cameras, strict=True)]
    kept = {key: value for key, value in rig.to_mapping().items() if key not in ("cameras", "lights")}
    return Rig.from_mapping({**kept, "cameras": made, "lights": leds})


def _calibrated(spec: Camera, camera: PinholeCamera) -> dict[str, Any]:
    """Return the mapping of a camera whose pose and lens are those of a numeric one."""
    replaced = ("position_mm", "look_at_mm", "pan_deg", "tilt_deg", "roll_deg", "focal_length_px", "focal_length_mm",
                "sensor_mm", "principal_point_px", "distortion", "calibration")  # fmt: skip
    numbers = {
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t_mm": camera.t.tolist(),
        "distortion": distortion_data(camera.distortion),
        "valid_radius": finite_or_none(camera.reach),
    }
    return {**{k: v for k, v in spec.to_mapping().items() if k not in replaced}, "calibration": numbers}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Axis:
    """One axis of one part: the rig with an amount of its deviation, and the cameras that see a difference."""

    tolerance: int
    sd: float
    before: bool
    cameras: tuple[int, ...]
    moved: Callable[[float], RigGeometry]


def unit_errors(survey: RigPopulation, tolerances: Tolerances, noise: FeatureNoise, people: int) -> UnitErrors:
    """Compute errors of gaze by the tolerances of a rig, equation (8), for the first people of a population.

    Raises:
        InputError: a number is not one of the rig's parts.
    """
    scene = Scene.of(SceneSpec.from_mapping(survey.scene))
    axes = list(axes_of(scene, tolerances))
    parts = [_of_group(survey, noise, tolerances, group) for group in surveyed(survey, people)]
    errors, glints, outline = (np.concatenate(each) for each in zip(*parts, strict=True))
    enough = min(2, len(scene.rig.lights))
    return UnitErrors(
        errors_deg=frozen(errors),
        tolerance=frozen([axis.tolerance for axis in axes], np.int64),
        covered=frozen((glints >= enough) & (outline >= OUTLINE), bool),
    )


def axes_of(scene: Scene, tolerances: Tolerances) -> Iterator[_Axis]:
    """Yield the axes of all tolerances, and the rig moved along each."""
    rig, cameras = scene.rig, scene.spec.rig.cameras
    for k, one in enumerate(tolerances.tolerances):
        for number in _numbers(one, k, len(rig.lights), cameras):
            for axis in range(_AXES[one.part, one.quantity]):
                yield _Axis(
                    tolerance=k,
                    sd=one.sd,
                    before=one.when == "before",
                    cameras=tuple(range(len(rig.cameras))) if one.part == "led" else (number,),
                    moved=_mover(scene, one, number, axis),
                )


def _numbers(one: Tolerance, k: int, lights: int, cameras: Sequence[Camera]) -> Sequence[int]:
    """Return the numbers of the parts of tolerance k. Raises InputError if the rig has no such part."""
    count = lights if one.part == "led" else len(cameras)
    numbers: Sequence[int] = range(count) if one.number == "all" else [one.number]
    if one.part == "mirror":
        numbers = [n for n in numbers if n < count and cameras[n].mirror is not None]
    if not len(numbers) or max(numbers) >= count:
        raise InputError(f"the rig has no such {one.part}", path=f"tolerances.{k}.number")
    return numbers


def _mover(scene: Scene, one: Tolerance, number: int, axis: int) -> Callable[[float], RigGeometry]:
    rig = scene.rig
    if one.part == "led":
        return lambda amount: _with_light(rig, number, np.eye(3)[axis] * amount)
    if one.part == "mirror":
        return lambda amount: _with_mirror(scene, number, one.quantity, axis, amount)
    return lambda amount: _with_camera(rig, number, _deviating(rig.cameras[number], one.quantity, axis, amount))


def _with_light(rig: RigGeometry, number: int, shift_mm: Floats) -> RigGeometry:
    lights = list(rig.lights)
    lights[number] = replace(lights[number], position_mm=frozen(lights[number].position_mm + shift_mm))
    return replace(rig, lights=tuple(lights))


def _with_camera(rig: RigGeometry, number: int, camera: PinholeCamera) -> RigGeometry:
    return replace(rig, cameras=tuple(camera if k == number else old for k, old in enumerate(rig.cameras)))


def _with_mirror(scene: Scene, number: int, quantity: str, axis: int, amount: float) -> RigGeometry:
    spec = scene.spec
    cameras = list(spec.rig.cameras)
    mirror = _moved_mirror(cameras[number], quantity, axis, amount)
    cameras[number] = cameras[number].model_copy(update={"mirror": mirror})
    return spec.rig.model_copy(update={"cameras": tuple(cameras)}).build(spec.subject.ipd_mm)


def _deviating(camera: PinholeCamera, quantity: str, axis: int, amount: float) -> PinholeCamera:
    """Turn a camera about its nodal point and own axes, move it along them, or change its calibration."""
    K, R, t = np.array(camera.K), np.array(camera.R), np.array(camera.t)
    if quantity == "rotation_deg":
        turn = _about(np.eye(3)[axis], amount)
        R, t = turn @ R, turn @ t
    elif quantity == "position_mm":
        t[axis] -= amount
    elif quantity == "focal_length_percent":
        K[[0, 1], [0, 1]] *= 1.0 + amount / 100.0
    else:
        K[axis, 2] += amount
    return replace(camera, K=frozen(K), R=frozen(R), t=frozen(t))


def _moved_mirror(camera: Camera, quantity: str, axis: int, amount: float) -> Mirror:
    """Turn a camera's mirror about an axis in its plane through its point, or move it along its normal (axis 0)."""
    assert camera.mirror is not None
    normal, _ = camera.mirror.plane
    point = np.array(camera.mirror.point_mm, dtype=float)
    if quantity == "position_mm":
        point = point + amount * normal
    else:
        normal = _about(np.linalg.svd(normal[None])[2][1 + axis], amount) @ normal
    return camera.mirror.model_copy(update={"point_mm": tuple(point.tolist()), "normal": tuple(normal.tolist())})


def _about(axis: Floats, angle_deg: float) -> Floats:
    """Return the rotation (3, 3) by an angle about a unit vector (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.radians(angle_deg)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def _of_group(
    survey: RigPopulation, noise: FeatureNoise, tolerances: Tolerances, group: tuple[Scene, Case, Lids | None]
) -> tuple[Floats, Ints, Floats]:
    """Compute errors (p, 81, e, 2) deg, numbers of glints (p, 81) and shares of the outline (p, 81) of some people."""
    scene, case, lids = group
    rig, axes, occluders = scene.rig, list(axes_of(scene, tolerances)), survey.occluders
    i, free = len(case.theta), Unknowns.from_mapping(survey.unknowns).free()
    size = len(free)
    matrices, pulls = np.zeros((i, size, size)), np.zeros((len(axes), i, size))
    glints, outline = np.zeros((i, len(rig.lights)), dtype=bool), np.zeros(i)
    for number, camera in enumerate(rig.cameras):
        views = replace(case.instants, camera=np.full(i, number))
        slopes, _ = seen_features(views, case.theta, camera, (lids, occluders), free)
        matrices += information_of_views(slopes, noise, views.camera)
        outline, glints = np.maximum(outline, slopes.outline_ok.mean(axis=1)), glints | slopes.glint_ok
        rows = whitened_rows(slopes, noise, views.camera)
        for k, axis in enumerate(axes):
            if number in axis.cameras:
                pulls[k] += np.einsum("nra,nr->na", rows, _changes(views, case.theta, slopes, noise, axis))
    errors = _errors(case, matrices, pulls, noise, survey, np.array([axis.before for axis in axes]))
    shape = (-1, GRID * GRID)
    return errors.reshape(*shape, len(axes), 2), glints.sum(axis=1).reshape(shape), outline.reshape(shape)


def _changes(views: Views, theta: Floats, slopes: FeatureSlopes, noise: FeatureNoise, axis: _Axis) -> Floats:
    """Compute the change (n, features) of the features over their noise, for one standard deviation of an axis."""
    step = _STEP * axis.sd
    ahead, behind = (images_of(replace(views, rig=axis.moved(way * step)), theta, POINTS) for way in (1.0, -1.0))

    def change(name: str) -> Floats:
        moved: Floats = (getattr(ahead, name) - getattr(behind, name)) / (2.0 * _STEP)
        return np.where(np.isfinite(moved), moved, 0.0)[..., None]

    moving = replace(slopes, outline=change("outline_px"), glints=change("glints_px"))
    return whitened_rows(moving, noise, views.camera)[..., 0]


def _errors(
    case: Any, matrices: Floats, pulls: Floats, noise: FeatureNoise, survey: RigPopulation, before: Bools
) -> Floats:
    """Solve equation (8): errors (i, e, 2) deg of the line of sight by pulls (e, i, columns)."""
    unknowns = Unknowns.from_mapping(survey.unknowns)
    found = learned(case, matrices, noise, unknowns)
    every, own, cells = found.every, found.frame, GRID * GRID
    people = len(matrices) // cells
    g = np.moveaxis(pulls[:, :, every], 0, -1)  # (i, unknowns, e)
    rows = (cells * np.arange(people)[:, None] + CALIBRATION_CELLS).ravel()
    a, b = found.blocks
    shared = g[rows, own:] - np.swapaxes(b, 1, 2) @ np.linalg.solve(a, g[rows, :own])
    # S dp, without dividing by S: the sum over the calibration itself.
    learnt = shared.reshape(people, len(CALIBRATION_CELLS), *shared.shape[1:]).sum(axis=1) * before
    g[:, own:] += np.repeat(learnt, cells, axis=0)
    slopes = gaze_slopes(case.instants, case.theta)[:, :, every]
    scale = 1.0 / np.sqrt(np.einsum("iaa->ia", found.joint))
    scaled = found.joint * scale[:, :, None] * scale[:, None, :]
    moved = np.linalg.solve(scaled, g * scale[:, :, None]) * scale[:, :, None]
    return np.asarray(np.degrees(np.moveaxis(slopes @ moved, 1, 2)))
