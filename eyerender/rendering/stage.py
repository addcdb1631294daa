"""What is kept from frame to frame (scenes, textures, maps), and the set-up of a job's frame from it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from ..errors import InputError
from ..region.anatomy import Region
from ..region.mesh import RegionMesh, region_mesh
from ..rig.imaging import Ambient
from .environment import Ambience, Maps
from .exchange import Exchange
from .film import Exposed
from .frame import (
    RenderJob,
    boundary_waves,
    kinds,
    light_table,
    panel_lamps,
    panel_table,
    tables,
)
from .head import place_scene
from .irislight import IrisLight
from .irisrelief import IrisRelief, Shape
from .kept import KeptForEye
from .lampviews import LampViews
from .mattelight import MatteLight
from .meshed import Meshes, meshed
from .prepared import Prepared
from .pupillight import PupilLight
from .recorded import forget
from .region import RegionScene, Trees
from .subsurface import tissue_light
from .surround import Obstacle, Surround
from .values import Lights, Structure, Values
from .view import Textures

_REGIONS, _TEXTURES = 4, 8  # kept
_REMEMBERED = 32  # subjects; then recordings are made anew, because those of sizes that never come back take 3 MB each
_BESIDE = 50_000  # trees built beside frames: Embree and Dr.Jit keep 2 kB of every thread that has built one
_FARTHEST_MM = 60.0  # of places in the plane of a surround that have a grid


@dataclass(slots=True)
class _Next:
    """The jobs of the frame that comes next, and what other threads make of them: mesh, trees, and all the rest."""

    jobs: tuple[RenderJob, ...]
    posed: Future[RegionMesh] | None = None
    trees: Trees | None = None
    hosts: Future[tuple[Prepared, ...]] | None = None

    @property
    def region(self) -> Region | None:
        """The eye region of the jobs."""
        return self.jobs[0].region


class Stage:
    """Scenes, textures and maps.

    Args:
        beside: what makes what NumPy alone can make, in one other thread.
        obstacles: in the scene's frame about eyes without a region.
    """

    def __init__(self, beside: Executor, obstacles: Sequence[Obstacle] = ()) -> None:
        self._beside = beside
        self._surround = Surround(obstacles)
        self._textures: dict[Any, Textures] = {}
        self._regions: dict[Any, RegionScene] = {}  # the one that was used last is last
        self._filled = 0
        self._replaced: deque[Any] = deque(maxlen=_REGIONS)  # subjects whose scenes others took
        self._maps = Maps()
        self.meshes = Meshes()
        self._exchange = Exchange()
        self._shapes: KeptForEye[Shape] = KeptForEye()
        self._next: _Next | None = None
        self._beside_frames = 0

    @property
    def obstructed(self) -> bool:
        """Whether there are obstacles about eyes without a region."""
        return self._surround.obstructed

    def _expect(self, jobs: Sequence[RenderJob]) -> None:
        """Have the mesh of the next jobs made by another thread, but for a head mesh."""
        self._next = _Next(tuple(jobs))
        region = self._next.region
        if region is not None and region.head is None:
            self._next.posed = self._beside.submit(region_mesh, region, jobs[0].globe)

    def prepare(self) -> None:
        """Have what can be made of the next jobs without the device made by other threads, once all is launched."""
        after = self._next
        if after is None or (after.region is not None and after.posed is None):
            return
        if after.posed is not None and after.posed.exception():
            return  # its own frame shall raise the error
        job, posed = after.jobs[0], None if after.posed is None else after.posed.result()
        after.hosts = self._beside.submit(lambda: tuple(Prepared.made(one, posed) for one in after.jobs))
        # With one thread, kernels run while they are launched, so nothing is left to build trees beside.
        if job.region is not None and posed is not None and dr.thread_count() > 1 and self._beside_frames < _BESIDE:
            place = self._regions.get(RegionScene.key(job.region, job.globe))
            if place is not None and place.double and not place.shows(job.region, job.globe):
                after.trees = place.begun(posed)
                self._beside_frames += 1

    def set(
        self, jobs: Sequence[RenderJob], *, lit: bool = True, after: Sequence[RenderJob] = ()
    ) -> tuple[Exposed, Surround | RegionScene]:
        """Set up the frame of jobs and the surroundings of their eye, which keep their pose until the next call.

        Args:
            jobs: one job, or some that can share launches (see `together`).
            lit: whether radiance is wanted, not only what is seen where.
            after: the jobs of the next frame, if they are known.
        """
        hosts, place = self._prepared(tuple(jobs))
        host, job = hosts[0], jobs[0]
        region = place if isinstance(place, RegionScene) else None
        textures, views = self._textures_of(job), None
        # What is large and needs little is launched first, so that the device has work while NumPy prepares the rest.
        if isinstance(place, RegionScene):
            views = LampViews(host.views, place)
            textures = replace(textures, region=place.skin, lamp_views=views)
        else:
            textures = replace(textures, surround=place.geometry)
        structure = Structure(
            kinds(job.eye),
            bool(np.any(job.camera.distortion)),
            place.obstructed,
            region is not None,
            job.ambient.model_copy(update={"sun": None}) != Ambient(),
            region is not None and region.skin.is_sheet and job.look.scattering is not None,
        )
        windows = [one.parameters for one in hosts] if len(hosts) > 1 else []
        values = Values(structure, host.parameters, boundary_waves(job.eye), tables(job.eye), windows)
        if job.mesh_edge_mm is not None:
            values.surfaces = meshed(values.surfaces, self.meshes.of(job.eye, job.mesh_edge_mm))
        lamps = np.concatenate([one.lamps for one in hosts])
        lights = Lights(lamps, len(host.lamps) - len(job.lights), len(hosts))
        if lit and structure.scattering and region is not None and views is not None:
            tissues = tissue_light(job, values, lights, region, views, host.tissue_cells)
            textures = replace(textures, tissues=tissues)
        if structure.ambient:
            even = job.ambient.irradiance_w_m2 * 1e-3
            ambience = Ambience(even, panel_table(job.ambient, job.anchor_mm), job.ambient.map, self._maps)
            textures = replace(textures, ambience=ambience)
        returned = [one.returned for one in hosts]
        textures = replace(textures, pupil=PupilLight(values, lights, place.scene, returned))
        if lit:
            textures = self._lit(hosts, values, lights, textures, place, after)
        return Exposed(place.scene, values, lights, textures, hosts), place

    def _lit(
        self, hosts: tuple[Prepared, ...], values: Values, lights: Lights, textures: Textures,
        place: Surround | RegionScene, after: Sequence[RenderJob],
    ) -> Textures:  # fmt: skip
        """The textures with the light between surfaces; prepares the grids of the lamps' light that a frame can use."""
        job = hosts[0].job
        parts = panel_lamps(job.ambient, job.anchor_mm)
        if textures.ambience is not None:
            parts += textures.ambience.bright(job.anchor_mm)
        panels = Lights(light_table(parts, job.M, job.t), windows=len(hosts))
        read = self._exchange.begun(hosts, values, lights, panels, textures, place)
        if after:
            self._expect(after)
        solved = read()
        if not place.obstructed or (isinstance(place, RegionScene) and place.skin.is_sheet):
            lights.on_iris = IrisLight(values, lights, place.scene, textures.lamp_views)
        lights.relief = IrisRelief(job, values, lights, place.scene, textures, self._shapes)
        received = solved()
        if not place.obstructed:
            reach = [min(one.reach_mm, _FARTHEST_MM) for one in hosts]
            lights.on_matte = MatteLight(values, lights, place.scene, received, reach)
        return replace(textures, received=received)

    def _prepared(self, jobs: tuple[RenderJob, ...]) -> tuple[tuple[Prepared, ...], Surround | RegionScene]:
        """What NumPy makes of jobs, and their posed surroundings."""
        expected, self._next = self._next, None
        hosts: tuple[Prepared, ...] = ()
        trees: Trees | None = None
        if expected is not None:
            if expected.trees is not None:
                wait([expected.trees.built])  # whatever comes now, because it changes the same shapes
            if [id(job) for job in expected.jobs] == [id(job) for job in jobs]:
                trees = expected.trees
                hosts = () if expected.hosts is None else expected.hosts.result()
        place = self._place(jobs[0], hosts[0].posed if hosts else None, trees)
        return hosts or tuple(Prepared(job, place.posed) for job in jobs), place

    def _place(self, job: RenderJob, known: RegionMesh | None, trees: Trees | None) -> Surround | RegionScene:
        """Posed surroundings; the mesh of a region and its trees may be known."""
        if job.region is None:
            self._surround.show(job.look)
            return self._surround
        if self._surround.obstructed:
            raise InputError("obstacles cannot be combined with an eye region")
        place = self._region(job, known)
        place.show(job.region, job.globe, known, trees)
        return place

    def _region(self, job: RenderJob, known: RegionMesh | None) -> RegionScene:
        """The scene of a subject.

        A subject never seen before takes over that of another one, so recordings last. One that comes back after that
        gets a scene of its own, because subjects that take turns would else fill one again and again.
        """
        assert job.region is not None
        spec, globe = job.region, job.globe
        key = RegionScene.key(spec, globe)
        place = self._regions.pop(key, None)
        if place is None:
            full, back = len(self._regions) >= _REGIONS, key in self._replaced
            oldest = next((k for k, kept in self._regions.items() if kept.takes(spec)), None)
            if oldest is None or (back and not full):
                if full:
                    self._regions.pop(next(iter(self._regions)))
                forget()
                place = place_scene(spec, globe, known)
            else:
                place = self._regions.pop(oldest)
                self._replaced.append(oldest)
                self._filled += 1
                if self._filled % _REMEMBERED == 0:
                    forget()
                    dr.flush_malloc_cache()
                place.fill(spec, globe, known)
        self._regions[key] = place
        return place

    def _textures_of(self, job: RenderJob) -> Textures:
        key = (job.look.iris_seed, job.look.iris)
        if key not in self._textures:
            if len(self._textures) >= _TEXTURES:
                self._textures.pop(next(iter(self._textures)))
            self._textures[key] = Textures.of(job.look)
        return self._textures[key]
