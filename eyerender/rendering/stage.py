"""What is kept from frame to frame (scenes, textures, maps), and the set-up of a job's frame from it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from ..arrays import Bools, frozen
from ..errors import InputError
from ..region.anatomy import Region
from ..region.globe import Globe
from ..region.mesh import region_mesh
from ..rig import psf
from ..rig.camera import Window
from ..rig.imaging import Ambient
from .blur import Blur
from .environment import Ambience, Maps
from .exchange import Exchange
from .film import Exposed
from .frame import (
    RenderJob,
    boundary_waves,
    globe_of,
    kinds,
    light_table,
    panel_lamps,
    panel_table,
    parameters_of,
    returned_light,
    sun_lamps,
    tables,
)
from .head import place_scene
from .irislight import IrisLight
from .irisrelief import IrisRelief, Shape
from .kept import KeptForEye
from .lampviews import LampViews
from .mattelight import MatteLight
from .meshed import Meshes, meshed
from .plain import fine_pixels, plain_tiles
from .pupillight import PupilLight
from .recorded import forget
from .region import Expected, RegionScene
from .subsurface import TissueLight, tissue_light
from .surround import Obstacle, Surround
from .values import Lights, Structure, Values
from .view import Textures

_REGIONS, _TEXTURES = 4, 8  # kept
_REMEMBERED = 32  # subjects; then recordings are made anew, because those of sizes that never come back take 3 MB each
_FARTHEST_MM = 60.0  # of places in the plane of a surround that have a grid
_NOTHING_PLAIN = frozen(np.zeros((1, 1)), np.bool_)


class Stage:
    """Scenes, textures and maps; `obstacles` are in the scene's frame about eyes without a region."""

    def __init__(self, obstacles: Sequence[Obstacle] = ()) -> None:
        self._surround = Surround(obstacles)
        self._textures: dict[Any, Textures] = {}
        self._regions: dict[Any, RegionScene] = {}  # the one that was used last is last
        self._filled = 0
        self._replaced: deque[Any] = deque(maxlen=_REGIONS)  # subjects whose scenes others took
        self._maps = Maps()
        self.meshes = Meshes()
        self._exchange = Exchange()
        self._shapes: KeptForEye[Shape] = KeptForEye()
        self._expected: Expected | None = None

    def expect(self, job: RenderJob, beside: Executor) -> None:
        """Have the mesh made that the region of a later job needs."""
        if job.region is None or job.region.head is not None:
            return
        globe = globe_of(job.eye, job.M, job.t - job.anchor_mm)
        self._expected = job.region, globe, beside.submit(region_mesh, job.region, globe)

    def set(self, job: RenderJob, *, lit: bool = True) -> tuple[Exposed, Surround | RegionScene]:
        """Set up the frame of a job and the surroundings of its eye, which keep their pose until the next call.

        `lit`: whether radiance is wanted, not only what is seen where.
        """
        place = self._place(job)
        suns = sun_lamps(job.ambient, job.anchor_mm)
        job = replace(job, lights=(*job.lights, *suns))
        region = place if isinstance(place, RegionScene) else None
        structure = Structure(
            kinds(job.eye),
            bool(np.any(job.camera.distortion)),
            place.obstructed,
            region is not None,
            job.ambient.model_copy(update={"sun": None}) != Ambient(),
            region is not None and region.skin.is_sheet and job.look.scattering is not None,
        )
        anchor = job.anchor_mm
        values = Values(structure, parameters_of(job), boundary_waves(job.eye), tables(job.eye))
        if job.mesh_edge_mm is not None:
            values.surfaces = meshed(values.surfaces, self.meshes.of(job.eye, job.mesh_edge_mm))
        lights = Lights(light_table(job.lights, job.M, job.t), len(suns))
        textures = self._textures_of(job)
        if structure.ambient:
            even = job.ambient.irradiance_w_m2 * 1e-3
            ambience = Ambience(even, panel_table(job.ambient, anchor), job.ambient.map, self._maps)
            textures = replace(textures, ambience=ambience)

        def plain(window: Window) -> tuple[Bools, int]:
            if region is None:
                return _NOTHING_PLAIN, max(window[2:])
            return plain_tiles(region.posed, job.camera, anchor, window)

        pupil = PupilLight(values, lights, place.scene, returned_light(job))
        pupil.make()
        textures = replace(textures, pupil=pupil)
        if isinstance(place, Surround):
            textures = replace(textures, surround=place.geometry)
        if region is not None:
            views = LampViews(job.lights, anchor, _reach_mm(job), region if region.skin.is_sheet else None)
            tissues = _tissues(job, values, lights, region, views) if structure.scattering and lit else None
            textures = replace(textures, region=region.skin, lamp_views=views, tissues=tissues)
        if lit:
            parts = panel_lamps(job.ambient, anchor)
            if textures.ambience is not None:
                parts += textures.ambience.bright(anchor)
            panels = Lights(light_table(parts, job.M, job.t))
            received = self._exchange.received(job, values, lights, panels, textures, place)
            textures = replace(textures, received=received)
            lights.relief = IrisRelief(job, values, lights, place.scene, textures, self._shapes)
        _spread(job, values, lights, textures, place)

        def fine(window: Window) -> tuple[Bools, Bools]:
            return fine_pixels(None if region is None else region.posed, job.camera, anchor, window)

        return Exposed(place.scene, values, lights, textures, plain, fine), place

    def _place(self, job: RenderJob) -> Surround | RegionScene:
        if job.region is None:
            self._surround.show(job.look)
            return self._surround
        if self._surround.obstructed:
            raise InputError("obstacles cannot be combined with an eye region")
        globe = globe_of(job.eye, job.M, job.t - job.anchor_mm)
        expected, self._expected = self._expected, None
        place = self._region(job.region, globe, expected)
        place.show(job.region, globe, expected)
        return place

    def _region(self, spec: Region, globe: Globe, expected: Expected | None) -> RegionScene:
        """The scene of a subject.

        A subject never seen before takes over that of another one, so recordings last. One that comes back after that
        gets a scene of its own, because subjects that take turns would else fill one again and again.
        """
        key = RegionScene.key(spec, globe)
        place = self._regions.pop(key, None)
        if place is None:
            full, back = len(self._regions) >= _REGIONS, key in self._replaced
            oldest = next((k for k, kept in self._regions.items() if kept.takes(spec)), None)
            if oldest is None or (back and not full):
                if full:
                    self._regions.pop(next(iter(self._regions)))
                forget()
                place = place_scene(spec, globe, expected)
            else:
                place = self._regions.pop(oldest)
                self._replaced.append(oldest)
                self._filled += 1
                if self._filled % _REMEMBERED == 0:
                    forget()
                    dr.flush_malloc_cache()
                place.fill(spec, globe, expected)
        self._regions[key] = place
        return place

    def _textures_of(self, job: RenderJob) -> Textures:
        key = (job.look.iris_seed, job.look.iris)
        if key not in self._textures:
            if len(self._textures) >= _TEXTURES:
                self._textures.pop(next(iter(self._textures)))
            self._textures[key] = Textures.of(job.look)
        return self._textures[key]


def _spread(job: RenderJob, values: Values, lights: Lights, textures: Textures, place: Surround | RegionScene) -> None:
    """Prepare the grids of the lamps' light that a frame can use."""
    if not place.obstructed or (isinstance(place, RegionScene) and place.skin.is_sheet):
        lights.on_iris = IrisLight(values, lights, place.scene, textures.lamp_views)
    if textures.received is not None and not place.obstructed:
        reach = min(_reach_mm(job), _FARTHEST_MM)
        lights.on_matte = MatteLight(values, lights, place.scene, textures.received, reach)


def _tissues(job: RenderJob, values: Values, lights: Lights, region: RegionScene, views: LampViews) -> TissueLight:
    spare_px = Blur.of(job, region).reach + psf.margin(job.sensor.psf_sigma_px)
    return tissue_light(job, values, lights, region, views, spare_px)


def _reach_mm(job: RenderJob) -> float:
    """Distance from the apex of the unrotated eye within which the window shows skin, mm; with some to spare."""
    x0, y0, width, height = job.window
    corners = np.array([[x0, y0], [x0 + width, y0], [x0, y0 + height], [x0 + width, y0 + height]], dtype=float) - 0.5
    apex = job.camera.project(job.anchor_mm)[0]
    px_per_mm = float(job.camera.scale_at(job.anchor_mm))
    if not (np.all(np.isfinite(apex)) and px_per_mm > 0):
        return np.inf
    return 1.5 * float(np.max(np.linalg.norm(corners - apex, axis=1))) / px_per_mm + 5.0
