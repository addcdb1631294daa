"""What NumPy alone makes of a job: nothing here asks the device, so a second thread can do it beside the tracing."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

from ..arrays import Bools, Floats, frozen
from ..eye.fundus import FundusLight
from ..region.mesh import RegionMesh, region_mesh
from ..rig.camera import Window
from .blur import Blur
from .frame import RenderJob, light_table, parameters_of, returned_light, sun_lamps
from .occlusion import lid_margins_px
from .parameters import Parameters
from .places import GlobePlaces, globe_places
from .plain import fine_pixels, plain_tiles
from .splat import MirrorImages
from .tissuecells import TissueCells

_NO_TILES = frozen([[False]], bool)


class Prepared:
    """What NumPy alone makes of a job. Every part is made when it is first asked for, or all by `made_beside`.

    Args:
        job: the job.
        posed: the mesh of its region, None for a bare eye.
    """

    def __init__(self, job: RenderJob, posed: RegionMesh | None) -> None:
        self.job, self.posed = job, posed
        self._tiles: dict[Window, tuple[Bools, int]] = {}
        self._fine: dict[Window, tuple[Bools, Bools]] = {}

    @classmethod
    def made_beside(cls, job: RenderJob) -> Prepared:
        """Make all that a picture needs, with the mesh of a procedural region."""
        made = cls(job, None if job.region is None else region_mesh(job.region, job.globe))
        _ = made.parameters, made.lamps, made.returned, made.places, made.lid_margins_px
        if job.mesh_edge_mm is None:
            _ = made.mirror_images
        if made.posed is not None:
            made.plain(made.blur.window)
            made.fine(made.blur.window)
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
    def lamps(self) -> Floats:
        """The lamps and the sun in the eye frame, as in `light_table`."""
        return light_table(self.sunlit.lights, self.job.M, self.job.t)

    @cached_property
    def returned(self) -> FundusLight:
        """What the fundus returns of the lamps' light and the sun's."""
        return returned_light(self.sunlit)

    @cached_property
    def blur(self) -> Blur:
        """The lens."""
        return Blur.of(self.job, self.posed)

    @cached_property
    def mirror_images(self) -> MirrorImages:
        """The lamps' mirror images in the closed form of the cornea."""
        return MirrorImages.of(self.job, None)

    @cached_property
    def places(self) -> GlobePlaces:
        """The places on the globe where the light between surfaces is computed."""
        return globe_places(self.job.globe, self.posed)

    @cached_property
    def tissue_cells(self) -> TissueCells:
        """Where light in the tissues of a procedural region is computed."""
        assert self.posed is not None
        return TissueCells.of(self.job, self.posed, self.blur.border_px)

    @cached_property
    def lid_margins_px(self) -> dict[str, list[list[float]]] | None:
        """Landmarks along the lids, where there are any."""
        return None if self.posed is None else lid_margins_px(self.posed, self.job.camera, self.job.anchor_mm)

    def plain(self, window: Window) -> tuple[Bools, int]:
        """Which tiles of a window show nothing but skin and thin hairs, and their size (px)."""
        if window not in self._tiles:
            posed, job = self.posed, self.job
            nothing = _NO_TILES, max(window[2:])
            self._tiles[window] = nothing if posed is None else plain_tiles(posed, job.camera, job.anchor_mm, window)
        return self._tiles[window]

    def fine(self, window: Window) -> tuple[Bools, Bools]:
        """Which pixels (height, width) of a window may show menisci or thin hairs, and which may show menisci."""
        if window not in self._fine:
            self._fine[window] = fine_pixels(self.posed, self.job.camera, self.job.anchor_mm, window)
        return self._fine[window]
