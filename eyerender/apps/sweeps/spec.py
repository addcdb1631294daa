"""The spec of a sweep of rigs: a YAML file that names a scene and the values to vary, and the resulting layouts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from ...base.arrays import Floats
from ...base.errors import InputError
from ...base.spec import FileSpec, NonNegative, Positive, Spec, Vec3
from ...design.tolerances import Tolerances
from ...rig.light import MAX_LIGHTS
from ...scene import Scene, load_scene
from ...scene.people import Population
from ...scene.spec import SceneSpec

MAX_LAYOUTS = 100_000
LightCount = Annotated[int, Field(ge=1, le=MAX_LIGHTS)]


class SweptPlaces(Spec):
    """Positions in the world: a list, a curve, or a surface."""

    points_mm: Annotated[tuple[Vec3, ...], Field(min_length=1)] | None = Field(default=None, description="a list")
    curve_mm: Annotated[tuple[Vec3, ...], Field(min_length=2)] | None = Field(
        default=None, description="corners of a polyline, on which `count` places are evenly spaced"
    )
    surface_mm: Annotated[tuple[Vec3, ...], Field(min_length=4, max_length=4)] | None = Field(
        default=None, description="four corners, in order around; `count` is the number of columns and of rows"
    )
    count: LightCount | tuple[LightCount, LightCount] | None = Field(default=None, description="number of places")

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [name for name in ("points_mm", "curve_mm", "surface_mm") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError("give one of points_mm, curve_mm and surface_mm")
        wanted = {"points_mm": type(None), "curve_mm": int, "surface_mm": tuple}[given[0]]
        if not isinstance(self.count, wanted):
            raise ValueError(
                {"points_mm": "a list has no count", "curve_mm": "a curve needs count, a number",
                 "surface_mm": "a surface needs count: [columns, rows]"}[given[0]]
            )  # fmt: skip
        return self

    def places(self) -> Floats:
        """Return the positions (n, 3) mm in the world."""
        if self.points_mm is not None:
            return np.array(self.points_mm, dtype=float)
        if self.curve_mm is not None:
            assert isinstance(self.count, int)
            corners = np.array(self.curve_mm, dtype=float)
            length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
            at = np.linspace(0.0, length[-1], self.count) if self.count > 1 else length[-1:] / 2.0
            return np.stack([np.interp(at, length, corners[:, axis]) for axis in range(3)], axis=1)
        assert isinstance(self.count, tuple)
        a, b, c, d = np.array(self.surface_mm, dtype=float)
        u, v = (np.linspace(0.0, 1.0, n) if n > 1 else np.array([0.5]) for n in self.count)
        u, v = u[None, :, None], v[:, None, None]
        return np.asarray((1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)).reshape(-1, 3)


class SweptCamera(Spec):
    """Values of one camera to vary."""

    camera: Annotated[int, Field(ge=0)] = Field(default=0, description="number of the camera in the scene")
    places: SweptPlaces | None = Field(
        default=None, description="positions of the camera, which keeps its target or direction"
    )
    focal_length_px: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = Field(
        default=None, description="focal lengths, for a camera with focal_length_px"
    )
    focal_length_mm: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = Field(
        default=None, description="focal lengths, for a camera with focal_length_mm"
    )


class SweptLights(Spec):
    """LEDs that replace those of the scene; all but position and intensity is copied from the scene's first LED."""

    places: SweptPlaces = Field(description="positions of LEDs, or those from which `number` chooses")
    number: Annotated[tuple[LightCount, ...], Field(min_length=1)] | None = Field(
        default=None, description="numbers of LEDs, at the best of the positions; default: all of them"
    )
    intensity_mw_sr: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = Field(
        default=None, description="intensities of each LED"
    )


class Sweep(Spec):
    """Values to vary; the layouts are all combinations."""

    cameras: tuple[SweptCamera, ...] = Field(default=(), description="cameras that vary")
    lights: SweptLights | None = Field(default=None, description="LEDs that vary")
    resolution_scale: Annotated[tuple[Positive, ...], Field(min_length=1)] = Field(
        default=(1.0,), description="factors of the number of pixels of all cameras; sensors keep their size"
    )


class SweepSpec(FileSpec):
    """A sweep of rigs over a population."""

    scene: str = Field(description="scene file, relative to this file, or the name of a shipped one")
    population: str | Population = Field(default="adults", description="population for which the rigs are evaluated")
    people: Annotated[int, Field(ge=1, le=100_000)] = Field(default=40, description="number of people")
    seed: Annotated[int, Field(ge=0)] = Field(default=0, description="seed of the people")
    azimuth_deg: Annotated[float, Field(ge=1, le=60)] = Field(default=20.0, description="half range of gaze")
    elevation_deg: Annotated[float, Field(ge=1, le=60)] = Field(default=15.0, description="half range of gaze")
    slippage_mm: NonNegative = Field(default=1.5, description="standard deviation of the eyes' positions, per axis")
    relief_mm: NonNegative = Field(
        default=0.0, description="additional standard deviation of their distance: eye relief of a headset"
    )
    sharp_px: Positive = Field(default=1.0, description="largest circle of confusion within the sharp depth")
    tolerances: Tolerances | None = Field(
        default=None, description="deviations of units from each layout, as in a file of tolerances; default: none"
    )
    sweep: Sweep = Field(description="values to vary")

    def people_of(self) -> Population:
        """Return the population."""
        return Population(self.population) if isinstance(self.population, str) else self.population

    def base(self, folder: Path) -> Scene:
        """Load the base scene, from a file relative to a folder or a shipped one."""
        beside = folder / self.scene
        scene = load_scene(beside if beside.is_file() else self.scene)
        scene.refuse_lenses("layouts are swept", self.people_of())
        return scene


@dataclass(frozen=True, slots=True, kw_only=True)
class RigLayout:
    """One layout of a sweep."""

    number: int  # its number in the sweep
    values: Mapping[str, Any]  # the varied values, for tables
    scene: Mapping[str, Any]  # mapping of its scene
    lights: int  # number of LEDs to choose from those of the scene


def layouts_of(spec: SweepSpec, scene: Scene) -> list[RigLayout]:
    """Return all layouts of a sweep, each validated. Raises InputError, naming the key that does not fit the scene."""
    axes = list(_axes(spec.sweep, scene))
    total = int(np.prod([len(values) for _, values in axes], dtype=float))
    if total > MAX_LAYOUTS:
        raise InputError(f"gives {total} layouts; at most {MAX_LAYOUTS}", path="sweep")
    names = [name for name, _ in axes]
    base, found = scene.located().to_mapping(), []
    for number, values in enumerate(product(*(values for _, values in axes))):
        chosen = dict(zip(names, values, strict=True))
        data = _applied(base, spec.sweep, chosen)
        SceneSpec.from_mapping(data, source=f"layout {number}").rig.build()
        leds = (led["ring"]["count"] if led.get("ring") else 1 for led in data["rig"]["lights"])
        lights = chosen.get("number") or sum(leds)
        found.append(RigLayout(number=number, values=chosen, scene=data, lights=lights))
    return found


Axis = tuple[str, list[Any]]
"""Name and values of one varied quantity."""


def _axes(sweep: Sweep, scene: Scene) -> Iterator[Axis]:
    """Return the axes of a sweep: every varied value with its alternatives."""
    for k, swept in enumerate(sweep.cameras):
        yield from _camera_axes(swept, scene, f"sweep.cameras.{k}")
    if sweep.resolution_scale != (1.0,):
        if any(camera.calibration is not None for camera in scene.spec.rig.cameras):
            raise InputError("a calibrated camera has one size", path="sweep.resolution_scale")
        yield "resolution_scale", list(sweep.resolution_scale)
    if sweep.lights is not None:
        sites = len(sweep.lights.places.places())
        numbers = list(sweep.lights.number or (sites,))
        if max(numbers) > sites:
            raise InputError(f"must be at most {sites}, the number of places", path="sweep.lights.number")
        yield "number", numbers
        if sweep.lights.intensity_mw_sr is not None:
            yield "intensity_mw_sr", list(sweep.lights.intensity_mw_sr)


def _camera_axes(swept: SweptCamera, scene: Scene, path: str) -> Iterator[Axis]:
    """Return the axes of one camera."""
    specs = scene.spec.rig.cameras
    if swept.camera >= len(specs):
        raise InputError(f"there is no camera {swept.camera}", path=f"{path}.camera")
    camera = specs[swept.camera]
    if camera.calibration is not None:
        raise InputError("has a calibration, which fixes place and lens", path=f"{path}.camera")
    if swept.places is not None:
        yield f"camera {swept.camera} (mm)", swept.places.places().round(9).tolist()
    for key in ("focal_length_px", "focal_length_mm"):
        values = getattr(swept, key)
        if values is None:
            continue
        if getattr(camera, key) is None:
            raise InputError(f"the camera of the scene has no {key}", path=f"{path}.{key}")
        yield f"camera {swept.camera} {key}", list(values)


def _applied(base: Mapping[str, Any], sweep: Sweep, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Apply the chosen values to the mapping of the scene."""
    rig = dict(base["rig"])
    cameras = [dict(camera) for camera in rig["cameras"]]
    for swept in sweep.cameras:
        camera = cameras[swept.camera]
        for key in ("focal_length_px", "focal_length_mm"):
            if f"camera {swept.camera} {key}" in chosen:
                camera[key] = chosen[f"camera {swept.camera} {key}"]
        if swept.places is not None:
            camera["position_mm"] = chosen[f"camera {swept.camera} (mm)"]
    data = {**base, "rig": {**rig, "cameras": cameras}}
    scale = chosen.get("resolution_scale", 1.0)
    if scale != 1.0:
        data["rig"]["cameras"] = [_resized(camera, scale) for camera in cameras]
        sensor = SceneSpec.from_mapping(base).sensor
        data["sensor"] = {**base.get("sensor", {}), "pixel_pitch_um": sensor.pixel_pitch_um / scale}
        data["image"] = {k: v for k, v in base.get("image", {}).items() if k != "window_px"}
    if sweep.lights is not None:
        first = {k: v for k, v in rig["lights"][0].items() if k not in ("ring", "position_mm")}
        if "intensity_mw_sr" in chosen:
            first["intensity_mw_sr"] = chosen["intensity_mw_sr"]
        places = sweep.lights.places.places().round(9).tolist()
        data["rig"]["lights"] = [{**first, "position_mm": place} for place in places]
    return data


def _resized(camera: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """Return a camera with more or fewer pixels on the same sensor."""
    out = {**camera, "resolution_px": [max(1, round(scale * n)) for n in camera["resolution_px"]]}
    if camera.get("focal_length_px") is not None:
        out["focal_length_px"] = scale * camera["focal_length_px"]
    if camera.get("principal_point_px") is not None:
        # Pixel centres are at integers.
        out["principal_point_px"] = [scale * (v + 0.5) - 0.5 for v in camera["principal_point_px"]]
    return out
