"""Radiosity: interreflection of globe, lids, face or background, and of the iris in its chamber.

Interreflected light varies slowly, so it is computed at some hundred patches per pose, and pixels interpolate. With the
albedo rho_j of patch j and the form factors F_ij, the irradiance is

    E_i = E0_i + sum_j rho_j F_ij E_j        (so that the radiosity B = rho E obeys B_i = rho_i (E0_i + sum_j F_ij B_j))

where a patch sends the radiance B_j / pi. `patches` and `framepatches` choose the patches, `patchlight` gathers E0,
`formfactors` traces the rays between patches, `chamber` holds the form factors behind the cornea, and `radiosityfield`
is the lookup for kernels. The equations are solved by iteration, so all orders of reflection are included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...base.arrays import Bools, Floats, Ints
from ..records.frame import DeviceFrame, Lights, upload_array
from ..records.job import LampTable, RenderJob
from ..scene.background import Background
from ..scene.region import RegionScene
from .chamber import IRIS, IRIS_RINGS, PATCHES
from .chamber import TURNS as IRIS_TURNS
from .formfactors import share_of
from .framepatches import FramePatches, Lanes, Patches, PatchTables
from .patches import GlobePatches, fill_gaps
from .patchlight import Gathered, PatchLight, gather_light
from .radiosityfield import RadiosityField

_ROUNDS = 6
_UNLIT = (0.0, 1.0, 0.0, 0.0)  # numbers of a patch without interreflection, as in `RadiosityField`


@dataclass(slots=True, kw_only=True)
class PendingField:
    """A radiosity field without light yet: the device may be busy until `read`, and may work on during `solve`."""

    region: RegionScene | None
    patches: FramePatches
    field: RadiosityField
    lanes: Lanes
    gathered: Gathered | None

    @classmethod
    def gather(
        cls,
        cache: Patches,  # patches that do not change between frames of a subject
        frame: DeviceFrame,  # the frame, with the region and the ambient light
        job: RenderJob,  # its job
        lamps: LampTable,  # its lamps
        panels: LampTable,  # parts of its panels, and the bright parts of its map, as lamps
        globe: GlobePatches,  # the patches of the globe
        place: Background | RegionScene,  # its surroundings
    ) -> PendingField:
        """Start computing the direct light on the patches of a frame, and the form factors between them."""
        region = place if isinstance(place, RegionScene) else None
        patches = cache.of(job, globe, region)
        field = RadiosityField.dark(job.interreflection, patches.interior.chamber, globe, patches.plane)
        lanes = Lanes.of(patches, lamps, panels)
        gathered = None
        if job.interreflection or frame.structure.ambient:
            tables = PatchTables.upload(patches, lamps, lanes)
            gathered = gather_light(frame, Lights.upload(panels), field, tables, lanes)
        return cls(region=region, patches=patches, field=field, lanes=lanes, gathered=gathered)

    def read(self) -> PatchLight | None:
        """Copy the device's results; None if there is neither interreflection nor light from surroundings."""
        return None if self.gathered is None else self.gathered.read(self.patches, self.lanes)

    def solve(self, light: PatchLight | None) -> RadiosityField:
        """Solve for all light on the host, and set the light that the skin receives."""
        patches, region = self.patches, self.region
        if light is None:
            count = len(patches.points) if region is None else len(region.posed.vertices)
            others = np.tile(_UNLIT, (count, 1))
            if region is not None:
                region.skin.received = upload_array(others)
            return self.field.with_light(np.tile(_UNLIT, (patches.on_globe, 1)), others, np.zeros(IRIS))
        valid = light.rays.mean(light.rays.near)[: patches.on_globe] < 0.5
        if region is None:
            valid &= patches.globe.points[:, 0] > -patches.job.look.backdrop_distance_mm
        ambient = _ambient(patches, light)
        solution = _solve(patches, light, ambient, valid)
        globe, others = _outer_tables(patches, light, ambient, solution, valid)
        if region is not None:
            region.skin.received = patches.plan.at_vertices(others[: patches.on_skin])
            others = np.zeros((1, 4))
        for part in (globe, others):
            part[:, 1], part[:, 3] = share_of(part[:, 1], part[:, 3]), 0
        from_outside = (solution.gathered + ambient.sky)[patches.outside :]
        iris = _smooth_on_iris(patches, from_outside, 1.0)
        return self.field.with_light(
            globe, others, iris + _smooth_on_iris(patches, solution.inside + light.panels, 0.0)
        )


@dataclass(frozen=True, slots=True)
class _Ambient:
    """Irradiance of all patches from the soft part of the ambient light, and of the outside ones from all of it."""

    sky: Floats
    arriving: Floats


@dataclass(frozen=True, slots=True)
class _Solution:
    """Irradiance of all patches (`total`), and its parts from others by rays (`gathered`) and within the chamber."""

    total: Floats
    gathered: Floats
    inside: Floats


def _ambient(patches: FramePatches, light: PatchLight) -> _Ambient:
    """Compute the ambient light that arrives at the patches.

    Rays between patches determine the visible share of the soft part, shadow rays that of the rest.
    """
    rays, outside = light.rays, patches.outside
    arriving = light.hard * share_of(light.hard_lit, light.hard_free)
    if not np.any(light.soft):
        return _Ambient(np.zeros(outside + PATCHES), arriving)
    sky = rays.mean(rays.sky)
    return _Ambient(sky, arriving + light.soft * share_of(sky[:outside], rays.mean(rays.free)[:outside]))


def _solve(patches: FramePatches, light: PatchLight, ambient: _Ambient, valid: Bools) -> _Solution:
    """Iterate E <- E0 + rho F E."""
    outside, interior = patches.outside, patches.interior
    start = np.concatenate([light.direct + ambient.arriving, light.lamps + light.panels + ambient.sky[outside:]])
    total, gathered, inside = start, np.zeros(outside + PATCHES), np.zeros(PATCHES)
    if patches.job.interreflection:
        form_factors = light.rays.form_factors(_stand_in(patches, valid))
        more = light.rays.correction(light.direct, light.bare)
        more[:outside] += light.mirrored
        for _ in range(_ROUNDS):
            gathered = form_factors @ total + more
            limbus = total[outside - IRIS_TURNS : outside]
            inside = interior.form_factors @ total[outside:] + interior.limbus @ limbus
            total = start + gathered
            total[outside:] += inside
    return _Solution(total, gathered, inside)


def _stand_in(patches: FramePatches, valid: Bools) -> Ints:
    """Return the patch used for each patch: itself, or the nearest uncovered one on the globe."""
    out, points = np.arange(patches.outside + PATCHES), patches.globe.points
    if np.any(valid) and not np.all(valid):
        nearest = cKDTree(points[valid]).query(points[~valid])[1]
        out[: len(points)][~valid] = np.flatnonzero(valid)[nearest]
    return out


def _outer_tables(
    patches: FramePatches, light: PatchLight, ambient: _Ambient, solution: _Solution, valid: Bools
) -> tuple[Floats, Floats]:
    """Assemble tables of globe and background: light from others, from the sky, in total, and of the whole sky."""
    job, outside = patches.job, patches.outside
    in_region = patches.plan.skin is not None
    table = np.zeros((outside, 4))
    table[:, 0] = solution.gathered[:outside]
    table[:, 1], table[:, 3] = ambient.arriving, light.soft + light.hard
    table[:, 2] = solution.total[:outside] if job.interreflection else 0
    if not in_region:
        table[patches.on_globe :, 2] *= job.look.backdrop_albedo
    # Between lids the light varies fast from lid to lid, so it is averaged only along them.
    across = (1.0, 0.0 if in_region else 1.0)
    globe = fill_gaps(table[: patches.on_globe], valid, patches.globe.rows, patches.globe.columns, across)
    return globe, table[patches.on_globe : outside - IRIS_TURNS]


def _smooth_on_iris(patches: FramePatches, values: Floats, along: float) -> Floats:
    """Fill and smooth the patches' values in the plane of the iris: outside the chamber and along the turns."""
    known = patches.interior.chamber.valid[:IRIS]
    grids = (values[:IRIS].reshape(IRIS_RINGS, IRIS_TURNS), known.reshape(IRIS_RINGS, IRIS_TURNS))
    closed = [np.concatenate([g[:, -2:], g, g[:, :2]], axis=1).ravel() for g in grids]
    out = fill_gaps(closed[0], closed[1], IRIS_RINGS, IRIS_TURNS + 4, (along, 0.0))
    return np.asarray(out.reshape(IRIS_RINGS, -1)[:, 2:-2].ravel())
