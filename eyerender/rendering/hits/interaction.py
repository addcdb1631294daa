"""The surface interaction: the record that ray hits fill and shading reads."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...rig.distortion import is_fisheye
from ..materials.albedo import sclera_albedo
from ..materials.gloss import glossy_normal, rippled_film
from ..records.frame import DeviceFrame
from ..records.recording import syntax
from ..records.surfaces import Bundle

EPSILON_MM = 2e-3  # points closer than this coincide in single precision
_WET = 0.93  # gloss of the sclera
_DEEPEST = 0.75  # least inverse depth of the image of an iris, relative to the cornea's: grazing rays come from afar


@dataclass(kw_only=True)
class SurfaceInteraction:
    """First surface that a ray meets, and the surface behind the cornea. Points and normals are in the eye frame."""

    cornea: mi.Bool  # whether the ray enters through the clear part of the cornea
    sclera: mi.Bool  # whether it meets the sclera
    other: mi.Bool  # whether it meets anything of the scene that is not the eye
    distance: mi.Float  # distance to the first surface, mm
    point: mi.Vector3f  # point on the first surface
    normal: mi.Vector3f  # unit normal there
    opacity: mi.Float  # opacity of the tissue there: 0 clear cornea, 1 sclera
    mirrored: mi.Float  # reflectance of the front cornea
    passed: mi.Float  # transmittance of the refracted ray, 0 where it does not reach the plane of the iris
    inner: mi.Vector3f  # point in the plane of the iris
    slant: mi.Vector3f  # lateral motion of the ray per mm of height above that plane
    pupil: mi.Bool  # whether the inner point lies in the pupil
    albedo: mi.Float  # albedo of a surface that is not the eye
    gloss: mi.Float  # gloss of such a surface, or of the wet sclera
    # light that such a surface receives from other surfaces (see `radiosityfield.RadiosityField`)
    received: mi.Vector4f
    level: mi.Vector3f | None = None  # normal without the relief, on skin with subsurface scattering

    @classmethod
    def blank(cls) -> SurfaceInteraction:
        """Return the interaction of rays that meet nothing, to be filled."""
        # Separate arrays, because Dr.Jit writes the results of branches into them.
        cornea, sclera, other, pupil = (mi.Bool(False) for _ in range(4))
        distance, mirrored, passed, albedo = (mi.Float(0) for _ in range(4))
        point, normal, inner, slant = (mi.Vector3f(0) for _ in range(4))
        return cls(
            cornea=cornea, sclera=sclera, other=other, distance=distance, point=point, normal=normal,
            opacity=mi.Float(1), mirrored=mirrored, passed=passed, inner=inner, slant=slant, pupil=pupil,
            albedo=albedo, gloss=mi.Float(_WET), received=mi.Vector4f(0),
        )  # fmt: skip

    @property
    def matte(self) -> mi.Bool:
        """Whether the first surface is at least partly matte."""
        return (self.cornea & (self.opacity > 0)) | self.sclera | self.other

    @property
    def cover(self) -> mi.Float:
        """Matte share of the first surface."""
        return dr.select(self.cornea, self.opacity, 1)

    @property
    def globe(self) -> mi.Bool:
        """Whether the ray meets the eye."""
        return self.cornea | self.sclera

    @property
    def lit_inside(self) -> mi.Bool:
        """Whether light from behind the cornea is visible."""
        return self.cornea & (self.opacity < 1) & (self.passed > 0)

    @property
    def met(self) -> mi.Bool:
        """Whether the ray meets anything."""
        return self.cornea | self.sclera | self.other

    @syntax
    def nearness(self, frame: DeviceFrame, d: mi.Vector3f) -> mi.Float:
        """Compute the inverse depth (1/mm) of what camera rays along d (scene's frame) show, for defocus.

        Behind the cornea, this is the change of direction that keeps a ray on its point in the plane of the iris while
        the pinhole moves across the optical axis. The image is astigmatic, so two directions of motion are averaged.
        """
        near = dr.rcp(dr.maximum(self.distance * frame.axis_cosine(d), 1e-3))
        if dr.hint(self.lit_inside & (self.opacity < 0.5), exclude=[self, frame, d]):
            near = dr.clip(self._nearness_inside(frame, d), _DEEPEST * near, near)
        return near

    def _nearness_inside(self, frame: DeviceFrame, d: mi.Vector3f) -> mi.Float:
        """Compute the inverse depth (1/mm) of the plane of the iris behind the cornea."""
        camera, front = frame.camera, frame.surfaces[0]
        # Everything in a fisheye's picture is on the axis of its own.
        axes = mi.coordinate_system(d) if is_fisheye(camera.distortion) else (camera.right, camera.down)
        cosine = frame.axis_cosine(d)
        turned = [frame.vector_to_eye(cosine * (e - d * dr.dot(e, d))) for e in axes]
        moved = [frame.vector_to_eye(e) for e in axes]
        y, form = front.on_surface(self.point)
        w, none = frame.vector_to_eye(d), mi.Vector3f(0)
        at = []
        for points, ways in (([self.distance * e for e in turned], turned), (moved, [none, none])):
            bundle = front.bend(Bundle(y=y, w=w, da=points[0], db=points[1], wa=ways[0], wb=ways[1]), form)[0]
            for surface in frame.surfaces[1:]:
                bundle = surface.refract_bundle(bundle)[0]
            s = dr.dot(frame.stop.centre - bundle.y, frame.stop.normal) / dr.dot(bundle.w, frame.stop.normal)
            at.append((bundle.w, bundle.da + s * bundle.wa, bundle.db + s * bundle.wb))
        (w, a, b), (_, p, q) = at
        both = dr.dot(w, dr.cross(p, b)) + dr.dot(w, dr.cross(a, q))
        return 0.5 * both / dr.dot(w, dr.cross(a, b))


def tear_film(frame: DeviceFrame, si: SurfaceInteraction) -> tuple[mi.Vector3f, mi.Float]:
    """Return normal (eye frame) and gloss of the film that mirrors lamps; on some people's sclera it has ripples."""
    on = si.sclera & ~si.other & (frame.sclera.ripples > 0)
    normal, gloss = rippled_film(si.normal, frame.sclera.ripples, si.distance / frame.camera.focal[0])
    return dr.select(on, normal, glossy_normal(si.normal, si.gloss)), dr.select(on, gloss, si.gloss)


@syntax
def outer_albedo(frame: DeviceFrame, si: SurfaceInteraction) -> mi.Float:
    """Return the albedo of the first surface where it is matte: sclera, limbus' rim, or the scene's own material."""
    albedo = mi.Float(si.albedo)
    if dr.hint(~si.other, exclude=[frame, si]):
        albedo = sclera_albedo(frame, si.point)
    return albedo
