"""Host-side precomputation for a job; never touches the device, so a second thread may run it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bools, Floats, Singles
from ...eye.fundus import FundusLight
from ...region.mesh import RegionMesh
from ...rig.camera import Window
from ..glints.splatting import MirrorImages
from ..records.frame import DeviceFrame
from ..records.job import LampTable, RenderJob, parameters_of, returned_light, sun_lamps
from ..records.parameters import Parameters
from ..scene.blur import Blur
from ..scene.diffusiongrids import DiffusionGrids
from ..scene.pixels import lid_margins_px, skin_only_tiles, supersampled_pixels
from ..transport.patches import GlobePatches, globe_patches
from ..transport.shadowmaps import shadow_map_table

FINE, WET, PLAIN = 1, 2, 4  # classes of pixels


class HostData:
    """Host-side precomputation for a job. Every part is computed on first use, or all by `compute`.

    Args:
        job: the job.
        posed: the posed mesh of its region; None for a bare eye.
    """

    def __init__(self, job: RenderJob, posed: RegionMesh | None) -> None:
        self.job, self.posed = job, posed
        self._marks: dict[Window, NDArray[np.uint8]] = {}

    @classmethod
    def compute(cls, job: RenderJob, posed: RegionMesh | None) -> HostData:
        """Compute everything that the image needs."""
        data = cls(job, posed)
        _ = data.parameters, data.lamps, data.lit_through, data.returned, data.patches, data.lid_margins_px
        if job.mesh_edge_mm is None:
            _ = data.mirror_images
        if data.posed is not None:
            data.marks(data.blur.window)
            _ = data.shadow_map_table
            if job.look.scattering is not None:
                _ = data.tissue_cells
        return data

    @cached_property
    def sunlit(self) -> RenderJob:
        """The job, with the sun (if any) as its last lamp."""
        suns = sun_lamps(self.job.ambient, self.job.anchor_mm)
        return replace(self.job, lights=(*self.job.lights, *suns))

    @cached_property
    def parameters(self) -> Parameters:
        """Frame parameters on the host."""
        return parameters_of(self.job)

    @cached_property
    def lamps(self) -> LampTable:
        """Lamps and sun in the eye frame."""
        job, lights = self.job, self.sunlit.lights
        return LampTable.of(lights, job.M, job.t, len(lights) - len(job.lights))

    @cached_property
    def around_mm(self) -> Floats:
        """Positions of lamps, sun and camera in the eye frame, (n, 3) mm."""
        job = self.job
        return np.concatenate([self.lamps.rows[:, :3], [(job.camera.nodal_point_mm - job.t) @ job.M]])

    @cached_property
    def lit_through(self) -> Bools:
        """True for each lamp that lights the eye through worn lenses, (n,)."""
        lenses = self.job.turned_lenses
        return self.lamps.lit_through(lenses) if lenses else np.zeros(len(self.lamps), dtype=bool)

    @property
    def through(self) -> bool | None:
        """Whether the lamps light the eye through worn lenses; None if some do."""
        some, every = bool(self.lit_through.any()), bool(self.lit_through.all())
        return some if some == every or not some else None

    @cached_property
    def returned(self) -> FundusLight:
        """Light of the lamps and the sun that the fundus returns."""
        return returned_light(self.sunlit)

    @cached_property
    def blur(self) -> Blur:
        """Defocus of the job."""
        return Blur.of(self.job, self.posed)

    @cached_property
    def reach_mm(self) -> float:
        """Distance from the apex of the unrotated eye within which the window shows skin, with a margin."""
        job = self.job
        x0, y0, width, height = job.window
        corners = np.array([[x, y] for x in (x0, x0 + width) for y in (y0, y0 + height)], dtype=float) - 0.5
        apex = job.camera.project(job.anchor_mm)[0]
        px_per_mm = float(job.camera.scale_at(job.anchor_mm))
        if not (np.all(np.isfinite(apex)) and px_per_mm > 0):
            return np.inf
        return 1.5 * float(np.max(np.linalg.norm(corners - apex, axis=1))) / px_per_mm + 5.0

    @cached_property
    def shadow_map_table(self) -> Singles:
        """Table of the shadow maps of all lamps, and of the sun, for a region."""
        return shadow_map_table(self.sunlit.lights, self.job.anchor_mm, self.reach_mm)

    @cached_property
    def mirror_images(self) -> MirrorImages:
        """Mirror images of the lamps in the closed-form cornea."""
        return MirrorImages.of(self.job, None)

    @cached_property
    def patches(self) -> GlobePatches:
        """Patches of the globe that exchange light."""
        return globe_patches(self.job.globe, self.posed)

    @cached_property
    def tissue_cells(self) -> DiffusionGrids:
        """Grid cells where subsurface light of a procedural region is computed."""
        assert self.posed is not None
        return DiffusionGrids.of(self.job, self.posed, self.blur.border_px)

    @cached_property
    def lid_margins_px(self) -> dict[str, list[list[float]]] | None:
        """Landmarks along the lids; None for a bare eye."""
        return (
            None
            if self.posed is None
            else lid_margins_px(self.posed, self.job.viewer(thorough=True), self.job.anchor_mm)
        )

    def marks(self, window: Window) -> NDArray[np.uint8]:
        """Classify a window's pixels, row by row, as sums of `FINE`, `WET` and `PLAIN`.

        A pixel is `FINE` if it may show thin hairs or menisci, `WET` if it may show menisci, and `PLAIN` if it shows
        only the sheet of skin.
        """
        if window not in self._marks:
            camera, anchor = self.job.viewer(), self.job.anchor_mm
            fine, wet = supersampled_pixels(self.posed, camera, anchor, window)
            plain = np.zeros_like(fine)
            # The edge of a lens or an obstacle may cross any pixel of skin.
            if self.posed is not None and not self.job.eye.worn and not self.job.obstacles:
                tiles, size = skin_only_tiles(self.posed, camera, anchor, window)
                plain = tiles.repeat(size, 0).repeat(size, 1)[: window[3], : window[2]] & ~fine
            self._marks[window] = (fine * FINE + wet * WET + plain * PLAIN).astype(np.uint8).ravel()
        return self._marks[window]


@dataclass(frozen=True, slots=True)
class BoundFrame:
    """A frame on the device, ready to be rendered.

    Attributes:
        frame: the frame.
        host: the host data of its job.
        lit_at: the host data at whose pose the light behind the cornea was computed; None: at that of `host`.
    """

    frame: DeviceFrame
    host: HostData
    lit_at: HostData | None = None
