"""What NumPy alone makes of a job: nothing here asks the device, so a second thread can do it beside the tracing."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...arrays import Bools, Ints, Singles, frozen
from ...eye.fundus import FundusLight
from ...region.mesh import RegionMesh
from ...rig.camera import Window
from ..glints.occlusion import lid_margins_px
from ..glints.splatting import MirrorImages
from ..records.frame import aligned_copy
from ..records.job import LampTable, RenderJob, parameters_of, returned_light, sun_lamps
from ..records.parameters import Parameters
from ..scene.blur import Blur
from ..scene.diffusiongrids import DiffusionGrids
from ..scene.pixels import skin_only_tiles, supersampled_pixels
from ..transport.patches import GlobePatches, globe_patches
from ..transport.shadowmaps import shadow_map_table

_NO_TILES = frozen([[False]], bool)


class HostData:
    """What NumPy alone makes of a job. Every part is made when it is first asked for, or all by `made`.

    Args:
        job: the job.
        posed: the mesh of its region, None for a bare eye.
    """

    def __init__(self, job: RenderJob, posed: RegionMesh | None) -> None:
        self.job, self.posed = job, posed
        self._tiles: dict[Window, tuple[Bools, int]] = {}
        self._fine: dict[Window, tuple[NDArray[np.uint32], Ints]] = {}

    @classmethod
    def made(cls, job: RenderJob, posed: RegionMesh | None) -> HostData:
        """Make all that a picture needs."""
        made = cls(job, posed)
        _ = made.parameters, made.lamps, made.returned, made.patches, made.lid_margins_px
        if job.mesh_edge_mm is None:
            _ = made.mirror_images
        if made.posed is not None:
            made.plain(made.blur.window)
            made.fine(made.blur.window)
            _ = made.views
            if job.look.scattering is not None:
                _ = made.tissue_cells
        return made

    @cached_property
    def sunlit(self) -> RenderJob:
        """The job with the sun, if there is one, as its last lamp."""
        suns = sun_lamps(self.job.ambient, self.job.anchor_mm)
        return replace(self.job, lights=(*self.job.lights, *suns))

    @cached_property
    def parameters(self) -> Parameters:
        """The numbers of the frame."""
        return parameters_of(self.job)

    @cached_property
    def lamps(self) -> LampTable:
        """The lamps and the sun in the eye frame."""
        job, lights = self.job, self.sunlit.lights
        return LampTable.of(lights, job.M, job.t, len(lights) - len(job.lights))

    @cached_property
    def returned(self) -> FundusLight:
        """What the fundus returns of the lamps' light and the sun's."""
        return returned_light(self.sunlit)

    @cached_property
    def blur(self) -> Blur:
        """The lens."""
        return Blur.of(self.job, self.posed)

    @cached_property
    def reach_mm(self) -> float:
        """Distance from the apex of the unrotated eye within which the window shows skin; with some to spare."""
        job = self.job
        x0, y0, width, height = job.window
        corners = np.array([[x, y] for x in (x0, x0 + width) for y in (y0, y0 + height)], dtype=float) - 0.5
        apex = job.camera.project(job.anchor_mm)[0]
        px_per_mm = float(job.camera.scale_at(job.anchor_mm))
        if not (np.all(np.isfinite(apex)) and px_per_mm > 0):
            return np.inf
        return 1.5 * float(np.max(np.linalg.norm(corners - apex, axis=1))) / px_per_mm + 5.0

    @cached_property
    def views(self) -> Singles:
        """Numbers of the lamps' views of a region, the sun's too."""
        return shadow_map_table(self.sunlit.lights, self.job.anchor_mm, self.reach_mm)

    @cached_property
    def mirror_images(self) -> MirrorImages:
        """The lamps' mirror images in the closed form of the cornea."""
        return MirrorImages.of(self.job, None)

    @cached_property
    def patches(self) -> GlobePatches:
        """The patches of the globe between which light is exchanged."""
        return globe_patches(self.job.globe, self.posed)

    @cached_property
    def tissue_cells(self) -> DiffusionGrids:
        """Where light in the tissues of a procedural region is computed."""
        assert self.posed is not None
        return DiffusionGrids.of(self.job, self.posed, self.blur.border_px)

    @cached_property
    def lid_margins_px(self) -> dict[str, list[list[float]]] | None:
        """Landmarks along the lids, where there are any."""
        return None if self.posed is None else lid_margins_px(self.posed, self.job.camera, self.job.anchor_mm)

    def plain(self, window: Window) -> tuple[Bools, int]:
        """Which tiles of a window show nothing but skin and thin hairs, and their size (px)."""
        if window not in self._tiles:
            posed, job = self.posed, self.job
            nothing = _NO_TILES, max(window[2:])
            self._tiles[window] = (
                nothing if posed is None else skin_only_tiles(posed, job.camera, job.anchor_mm, window)
            )
        return self._tiles[window]

    def fine(self, window: Window) -> tuple[NDArray[np.uint32], Ints]:
        """Pixels of a window that may show menisci or thin hairs, in the order of its rows.

        Returns:
            For each pixel of the window 1 if it may show either, plus 2 if it may show menisci, plus 4 k if it is the
            k-th of those that may show either; and the indices of these.
        """
        if window not in self._fine:
            fine, wet = supersampled_pixels(self.posed, self.job.camera, self.job.anchor_mm, window)
            chosen = np.flatnonzero(fine)
            marks = aligned_copy((fine + 2 * wet).astype(np.uint32).ravel())
            marks[chosen] |= 4 * np.arange(1, len(chosen) + 1, dtype=np.uint32)
            self._fine[window] = marks, chosen
        return self._fine[window]
