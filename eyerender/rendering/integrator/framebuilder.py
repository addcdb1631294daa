"""Caches that survive between frames (scenes, textures, maps), and per-frame set-up."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Cache
from ...region.mesh import RegionMesh, region_mesh
from ...rig.distortion import is_distorted
from ...rig.imaging import Ambient
from ..hits.meshes import Meshes, meshed
from ..materials.albedo import Textures
from ..records.frame import DeviceFrame, Lights, Structure, upload_array
from ..records.job import LampTable, RenderJob, boundary_waves, kinds, lens_kinds, panel_lamps, panel_table, tables
from ..records.recording import forget, recorded
from ..scene.background import Background
from ..scene.diffusiongrids import skin_grain
from ..scene.head import HeadScene
from ..scene.region import RegionScene
from ..transport.diffusion import DiffusedLight
from ..transport.environment import Ambience, Maps, bright_lamps
from ..transport.framepatches import Patches
from ..transport.fundusirradiance import FundusIrradiance
from ..transport.globeirradiance import GlobeIrradiance
from ..transport.irisirradiance import IrisIrradiance
from ..transport.radiosity import PendingField
from ..transport.reliefmapping import IrisRelief, ReliefShape, ReliefSize, relief_shape
from ..transport.shadowmaps import ShadowMaps
from .hostdata import BoundFrame, HostData

_REGIONS, _TEXTURES = 4, 8  # cached
_SUBJECTS = 32  # then recordings are forgotten, because those of sizes that never come back take 3 MB each
_FEWEST_PX = 40.0  # across the iris; in smaller images there are fewer samples than nodes of its grid
_SAME_LIGHT_RAD = np.radians(1.0)  # turn of an eye under its lamps that hardly changes the light behind its cornea
_FARTHEST_MM = 60.0  # half the largest width of the grid over the background's plane


@dataclass(slots=True)
class _Next:
    """The job of the next frame, with its region mesh and host data, which the second thread computes."""

    job: RenderJob
    posed: Future[RegionMesh] | None = None
    host: Future[HostData] | None = None


@recorded
def _grids_behind_cornea(
    frame: DeviceFrame, shape: ReliefShape | None, side: mi.UInt32, points: tuple[mi.UInt32, mi.UInt32],
    factors: mi.Float | None, lamps: int | None, relief: tuple[int, int],
) -> tuple[IrisIrradiance | None, IrisRelief, FundusIrradiance]:  # fmt: skip
    """Fill the irradiance grids behind the cornea: on the iris, on its relief, and on the fundus.

    The grid on the iris holds the light of `lamps` lamps; None: there is none. The numbers of `relief` are those of its
    nodes, and of the points on all lamps that light it. A lamp has `points` on the iris and on the relief.
    """
    pupil = FundusIrradiance.build(frame, factors)
    on_iris = None if lamps is None else IrisIrradiance.build(frame, lamps, points[0])
    return on_iris, IrisRelief.build(frame, shape, side, points[1], relief), pupil


def _is_lit_alike(host: HostData, other: HostData) -> bool:
    """Return whether an eye has the same pupil at two moments, and nearly the same directions of lamps and camera."""
    if host.job.eye is not other.job.eye:
        return False
    moved = np.linalg.norm(host.around_mm - other.around_mm, axis=1)
    return bool(np.all(moved <= _SAME_LIGHT_RAD * np.linalg.norm(other.around_mm, axis=1)))


class FrameBuilder:
    """Builder of frames from cached scenes, textures and maps.

    Args:
        beside: executor of one thread, for host work.
    """

    def __init__(self, beside: Executor) -> None:
        self._beside = beside
        self._background = self._obstructed = Background()
        self._textures: Cache[Textures] = Cache(_TEXTURES)
        self._regions: dict[Any, RegionScene] = {}  # least recently used first
        self._filled = 0
        self._replaced: deque[Any] = deque(maxlen=_REGIONS)  # subjects whose scenes were reused for others
        self._maps = Maps()
        self.meshes = Meshes()
        self._patches = Patches()
        self._shapes: Cache[ReliefShape] = Cache()
        self._next: _Next | None = None

    def _expect(self, job: RenderJob) -> None:
        """Start computing the mesh of the next job in the second thread; head meshes need none."""
        self._next = _Next(job)
        region = job.region
        if region is not None and region.head is None:
            self._next.posed = self._beside.submit(region_mesh, region, job.globe)

    def prepare(self) -> None:
        """Start the host work of the next job in the second thread, after this frame is launched."""
        after = self._next
        if after is None or (after.job.region is not None and after.posed is None):
            return
        if after.posed is not None and after.posed.exception():
            return  # its own frame raises the error
        posed = None if after.posed is None else after.posed.result()
        after.host = self._beside.submit(HostData.compute, after.job, posed)

    def set(
        self,
        job: RenderJob,
        *,
        lit: bool = True,
        after: RenderJob | None = None,
        before: BoundFrame | None = None,
    ) -> tuple[BoundFrame, Background | RegionScene]:
        """Set up the frame of a job and the surroundings of its eye; both are valid until the next call.

        `lit`: whether to compute light, not only geometry; `after`: the job of the next frame, if known;
        `before`: the previous frame under the same lamps. Its light between surfaces is reused, and its light behind
        the cornea too until the eye has turned notably.
        """
        host, surroundings = self._host_data(job)
        region = surroundings if isinstance(surroundings, RegionScene) else None
        look = job.look
        textures = self._textures.get((look.iris_seed, look.iris), lambda: Textures.of(look))
        # Large kernels that need few inputs are launched first, so that the device is busy while NumPy prepares the
        # rest.
        shadow_maps = (
            before.frame.caches.shadow_maps
            if before is not None
            else None
            if region is None
            else ShadowMaps.build(region, host.shadow_map_table)
        )
        structure = Structure(
            surfaces=kinds(job.eye),
            distorted=is_distorted(job.camera.distortion),
            measured_falloff=job.camera.relative_illumination is not None,
            obstacles=surroundings.obstructed,
            region=region is not None,
            ambient=job.ambient.model_copy(update={"sun": None}) != Ambient(),
            scattering=region is not None and region.skin.is_sheet and job.look.scattering is not None,
            lenses=lens_kinds(job.eye),
            lit_through=host.through,
        )
        frame = DeviceFrame.upload(structure, host.parameters, boundary_waves(job.eye), tables(job.eye))
        frame.lights = Lights.upload(host.lamps, frame.turned_lenses, host.lit_through)
        frame.textures, frame.scene = textures, surroundings.scene
        if isinstance(surroundings, RegionScene):
            frame.region = surroundings.skin
        else:
            frame.background = surroundings.geometry
        frame.caches.shadow_maps = shadow_maps
        if job.mesh_edge_mm is not None:
            frame.surfaces = meshed(frame.surfaces, self.meshes.of(job.eye, job.mesh_edge_mm))
        if lit and structure.scattering and region is not None:
            frame.caches.diffusion = (
                before.frame.caches.diffusion
                if before is not None
                else DiffusedLight.build(frame, job, host.lamps, region, host.tissue_cells)
            )
        if structure.ambient:
            even = job.ambient.irradiance_w_m2 * 1e-3
            panels = panel_table(job.ambient, job.anchor_mm)
            frame.caches.ambience = Ambience.build(even, panels, job.ambient.map, self._maps)
        lit_at: HostData | None = None
        if lit and before is not None:
            caches, lit_at = before.frame.caches, before.lit_at or before.host
            if _is_lit_alike(host, lit_at):
                frame.caches.iris, frame.caches.relief, frame.caches.fundus = caches.iris, caches.relief, caches.fundus
            else:
                self._fill_grids(host, frame, surroundings)
                lit_at = None
            frame.caches.radiosity = caches.radiosity
            self._fill_globe(host, frame, surroundings)
        elif lit:
            self._light(host, frame, surroundings, after)
        return BoundFrame(frame, host, lit_at), surroundings

    def _light(
        self, host: HostData, frame: DeviceFrame, surroundings: Background | RegionScene, after: RenderJob | None
    ) -> None:
        """Compute the radiosity and fill the irradiance grids that the frame can use."""
        job = host.job
        parts = panel_lamps(job.ambient, job.anchor_mm) + bright_lamps(job.ambient.map, self._maps, job.anchor_mm)
        panels = LampTable.of(parts, job.M, job.t)
        pending = PendingField.gather(self._patches, frame, job, host.lamps, panels, host.patches, surroundings)
        if after is not None:
            self._expect(after)
        gathered = pending.read()
        self._fill_grids(host, frame, surroundings)
        frame.caches.radiosity = pending.solve(gathered)
        self._fill_globe(host, frame, surroundings)

    def _fill_globe(self, host: HostData, frame: DeviceFrame, surroundings: Background | RegionScene) -> None:
        """Fill the grid of the lamps' light on a bare globe."""
        if not surroundings.obstructed:
            reach = dr.opaque(mi.Float, min(host.reach_mm, _FARTHEST_MM))
            points = dr.opaque(mi.UInt32, host.lamps.points)
            frame.caches.globe = GlobeIrradiance.build(frame, reach, points, host.lamps.gridded)

    def _fill_grids(self, host: HostData, frame: DeviceFrame, surroundings: Background | RegionScene) -> None:
        """Fill the irradiance grids behind the cornea."""
        job, lamps, heights = host.job, host.lamps, frame.textures.heights
        size = ReliefSize.of(job)
        side, shape = dr.opaque(mi.UInt32, size.side), None
        if frame.textures.raised:
            shape = self._shapes.get(
                (job.eye, size.side, job.look.iris_seed, job.look.iris),
                lambda: relief_shape(frame.bare(), heights, side, dr.opaque(mi.UInt32, size.about), size),
            )
        gridded = not surroundings.obstructed or (isinstance(surroundings, RegionScene) and surroundings.skin.is_sheet)
        iris_px = 2 * float(job.eye.iris_root_radius_mm) * float(job.camera.scale_at(job.t))
        worthwhile = lamps.gridded and iris_px > _FEWEST_PX
        on_grid = (len(lamps) if worthwhile else 0) if gridded else None
        relief = size.side**2, lamps.points_on_relief * max(len(lamps), 1)
        factors = host.returned.factors
        sent_factors = upload_array(factors) if len(lamps) and factors.any() else None
        caches = frame.caches
        points = dr.opaque(mi.UInt32, lamps.points), dr.opaque(mi.UInt32, lamps.points_on_relief)
        caches.iris, caches.relief, caches.fundus = _grids_behind_cornea(
            frame, shape, side, points, sent_factors, on_grid, relief
        )

    def _host_data(self, job: RenderJob) -> tuple[HostData, Background | RegionScene]:
        """Return the host data of a job, and its posed surroundings."""
        expected, self._next = self._next, None
        host = None
        if expected is not None and expected.job is job and expected.host is not None:
            host = expected.host.result()
        surroundings = self._pose_surroundings(job, job.posed if host is None else host.posed)
        return host or HostData(job, surroundings.posed), surroundings

    def _pose_surroundings(self, job: RenderJob, known: RegionMesh | None) -> Background | RegionScene:
        """Pose the surroundings of a job; the mesh of a region may already be computed."""
        if job.region is None:
            bodies = job.bodies
            if bodies and not self._obstructed.takes(bodies):
                forget()
                self._obstructed = Background(bodies)
            background = self._obstructed if bodies else self._background
            background.show(job.look, bodies)
            return background
        surroundings = self._region(job, known)
        surroundings.show(job.region, job.globe, known)
        return surroundings

    def _region(self, job: RenderJob, known: RegionMesh | None) -> RegionScene:
        """Return the scene of a subject, from the cache or by refilling another one.

        A new subject reuses the scene buffers of an earlier one, so recordings stay valid. A subject that returns after
        its scene was reused gets its own scene, otherwise subjects that alternate would refill one scene forever. The
        second eye of a subject gets its own scene at once, because the first eye will return.
        """
        assert job.region is not None
        spec, globe, grain = job.region, job.globe, skin_grain(job)
        key = RegionScene.key(spec, globe, grain)
        surroundings = self._regions.pop(key, None)
        if surroundings is None:
            full, back = len(self._regions) >= _REGIONS, key in self._replaced
            sides = {k for k in self._regions if k[0].seed == spec.seed and k[1] != globe.mirrored}
            oldest = next(
                (k for k, kept in self._regions.items() if kept.takes(spec, globe, grain) and k not in sides), None
            )
            if oldest is None or (back and not full):
                if full:
                    self._regions.pop(next(iter(self._regions)))
                forget()
                surroundings = (RegionScene if spec.head is None else HeadScene)(spec, globe, known, grain)
            else:
                surroundings = self._regions.pop(oldest)
                self._replaced.append(oldest)
                self._filled += 1
                if self._filled % _SUBJECTS == 0:
                    forget()
                    dr.flush_malloc_cache()
                surroundings.fill(spec, globe, known)
        self._regions[key] = surroundings
        return surroundings
