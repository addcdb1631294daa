"""Export of a job to files that the stock `mitsuba` command renders: PLY meshes and XML, for independent checks.

    mitsuba -m scalar_rgb scene.xml        (or llvm_ad_rgb, cuda_ad_rgb)

Lengths are mm, radiance is mW/mm^2/sr. Features that stock Mitsuba lacks are left out, and the file says so: textures,
the relief of the iris, the limbus' soft rim and its lower height, menisci, light inside tissue, lens distortion, the
point-spread function, ambient light except the sun, and lamps that are neither Lambertian discs nor isotropic points.
"""

from __future__ import annotations

import hashlib
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...base.arrays import OBSTACLE, SPECTACLE_FRAME, Floats
from ...base.errors import InputError
from ...eye.meshes import Patch, eye_meshes, lens_patches
from ...eye.model import EyeModel
from ...region.anatomy import Region
from ...region.head import load_head, placed
from ...region.mesh import region_mesh
from ...rig.imaging import Ambient
from ..records.job import RenderJob, sun_lamps

_BACKDROP_HALF_MM = 500.0
_FILM_MM = 0.01  # three times the real thickness, which single precision would not resolve


def export_scene(
    job: RenderJob, folder: str | Path, *, spp: int = 64, max_depth: int = 12, rings: int = 48, sectors: int = 128
) -> Path:
    """Write `scene.xml` and `meshes/*.ply` for one job.

    Args:
        job: the job to export; its window becomes the film's crop.
        folder: an existing folder.
        spp: samples per pixel of the file's path integrator.
        max_depth: path depth of that integrator.
        rings: rings of the meshes.
        sectors: sectors of the meshes.

    Returns:
        The path of the XML file.

    Raises:
        InputError: the camera is a fisheye or its pixels are not square; Mitsuba's perspective sensor supports neither.
    """
    K = job.camera.K
    if job.camera.is_fisheye:
        raise InputError("the camera is a fisheye, which Mitsuba's perspective sensor does not support")
    if abs(K[0, 0] - K[1, 1]) > 1e-6 * K[0, 0]:
        raise InputError("the camera's pixels are not square, which Mitsuba's perspective sensor does not support")
    folder = Path(folder)
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    root = ET.Element("scene", version="3.0.0")
    for note in _notes(job):
        root.append(ET.Comment(f" {note} "))
    integrator = ET.SubElement(root, "integrator", type="path")
    _value(integrator, "integer", "max_depth", max_depth)
    _sensor(root, job, spp)
    look = job.look
    albedo = {
        "iris": look.iris_albedo,
        "sclera": look.sclera_albedo,
        "retina": look.pupil_albedo,
        "contact_lens_rim": look.limbus_albedo,
        "cornea_rim": look.limbus_albedo,
        "chamber_wall": look.limbus_albedo,
        "iris_root": look.limbus_albedo,
        "tear_film_rim": look.limbus_albedo,
    }
    motion = np.vstack([np.column_stack([job.M, job.t]), [0, 0, 0, 1]])
    patches = eye_meshes(job.eye, rings, sectors).patches
    more = [_root(job.eye, patches["chamber_wall"], sectors)]
    if look.tear_film:
        outer = next(iter(patches))
        film, patches[outer], rim = _film(patches[outer], job.film_index, sectors)
        more += [film, rim]
    for patch in (*patches.values(), *more):
        _patch(root, folder, patch, motion, albedo.get(patch.name, 0.0))
    place = np.eye(4)
    place[:3, 3] = job.anchor_mm
    for patch, matte in _surroundings(job, rings, sectors):
        _patch(root, folder, patch, place, matte)
    for k, body in enumerate(job.obstacles):
        patch = Patch(f"obstacle_{k}", body.vertices, body.normals, body.faces)
        _patch(root, folder, patch, np.eye(4), body.albedo)
    for k, lamp in enumerate((*job.lights, *sun_lamps(job.ambient, job.anchor_mm))):
        _lamp(root, k, lamp.position_mm, lamp.axis, float(lamp.radius_mm), float(lamp.intensity_mw_sr))
    ET.indent(root)
    path = folder / "scene.xml"
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return path


def bake_meshes(eye: EyeModel, folder: str | Path, *, rings: int = 24, sectors: int = 96) -> Path:
    """Write every patch of an eye as PLY, and describe them in `manifest.json`.

    The manifest states meaning, unit, frame, licence, refractive indices and SHA-256. Returns the path of the manifest.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    meshes = eye_meshes(eye, rings, sectors)
    files = {}
    for patch in meshes.patches.values():
        data = patch.mesh.export(file_type="ply", vertex_normal=True)
        (folder / f"{patch.name}.ply").write_bytes(data)
        files[f"{patch.name}.ply"] = {
            "sha256": hashlib.sha256(data).hexdigest(),
            "vertices": len(patch.vertices),
            "faces": len(patch.faces),
            "exterior_index": patch.exterior,
            "interior_index": patch.interior,
        }
    manifest = {
        "schema": "eyerender/meshes/1",
        "eye_model": eye.name,
        "side": eye.side,
        "wavelength_nm": eye.wavelength_nm,
        "unit": "mm",
        "frame": "eye: origin at the front corneal apex, +x outward, +z up; normals towards the exterior",
        "licence": "MIT",
        "rings": rings,
        "sectors": sectors,
        "bodies": sorted(meshes.bodies),
        "files": files,
    }
    path = folder / "manifest.json"
    path.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return path


def _notes(job: RenderJob) -> list[str]:
    notes = ["Written by eyerender. Lengths in mm, radiance in mW/mm^2/sr, reflectances at the job's wavelength."]
    if np.any(job.camera.distortion):
        notes.append("The camera's lens distortion is left out.")
    if job.flip:
        notes.append("The picture is the one before the camera's flip.")
    if job.camera.mirror is not None:
        notes.append("The mirror's outline, reflectance and ghosts are left out.")
    if any(lamp.radius_mm > 0 and lamp.lobe_exponent != 1 for lamp in job.lights):
        notes.append("Lamps with a lobe other than cos^1 are shown as Lambertian discs.")
    if any(lamp.radius_mm == 0 for lamp in job.lights):
        notes.append("Point lamps: a path tracer cannot light what lies behind the cornea with them.")
    if job.look.tear_film:
        notes.append(f"The tear film on the cornea is a dielectric layer of its own, {_FILM_MM} mm thick.")
    if job.ambient.model_copy(update={"sun": None}) != Ambient():
        notes.append("Even light, panels and the surrounding's map are left out.")
    if any(lens.reflectances or lens.transmission < 1 for lens in job.eye.worn):
        notes.append(
            "Coatings and absorption of spectacle lenses are left out: their surfaces have Fresnel's reflectance."
        )
    notes.append("Textures, the relief of the iris, the limbus' soft rim and its lower height, and the point-spread")
    notes.append("function are left out.")
    if job.region is not None:
        notes.append("Sheen, menisci and light inside skin and sclera are left out.")
    return notes


def _sensor(root: ET.Element, job: RenderJob, spp: int) -> None:
    camera, (width, height) = job.camera, job.camera.resolution_px
    sensor = ET.SubElement(root, "sensor", type="perspective")
    _value(sensor, "string", "fov_axis", "x")
    _value(sensor, "float", "fov", float(np.degrees(2 * np.arctan(width / 2 / camera.K[0, 0]))))
    # Mitsuba's pixels are [i, i + 1), so a centre at integer i is at i + 1/2 there.
    _value(sensor, "float", "principal_point_offset_x", float((camera.K[0, 2] + 0.5) / width - 0.5))
    _value(sensor, "float", "principal_point_offset_y", float((camera.K[1, 2] + 0.5) / height - 0.5))
    _value(sensor, "float", "near_clip", 1e-3)
    _value(sensor, "float", "far_clip", 1e5)
    # Mitsuba's camera looks along +z with +x to the left and +y up.
    pose = np.eye(4)
    pose[:3, :3] = (camera.sensor_axes * np.array([[-1.0], [-1.0], [1.0]])).T
    pose[:3, 3] = camera.nodal_point_mm
    _transform(sensor, pose)
    film = ET.SubElement(sensor, "film", type="hdrfilm")
    x0, y0, w, h = job.window
    for name, value in (("width", width), ("height", height), ("crop_offset_x", x0), ("crop_offset_y", y0),
                        ("crop_width", w), ("crop_height", h)):  # fmt: skip
        _value(film, "integer", name, value)
    _value(film, "string", "pixel_format", "luminance")
    ET.SubElement(film, "rfilter", type="box")
    sampler = ET.SubElement(sensor, "sampler", type="independent")
    _value(sampler, "integer", "sample_count", spp)


def _patch(root: ET.Element, folder: Path, patch: Patch, motion: Floats, albedo: float) -> None:
    file = f"meshes/{patch.name}.ply"
    (folder / file).write_bytes(patch.mesh.export(file_type="ply", vertex_normal=True))
    shape = ET.SubElement(root, "shape", type="ply", id=patch.name)
    _value(shape, "string", "filename", file)
    _transform(shape, motion)
    if patch.interior is not None and patch.exterior is not None:
        material = ET.SubElement(shape, "bsdf", type="dielectric")
        _value(material, "float", "int_ior", patch.interior)
        _value(material, "float", "ext_ior", patch.exterior)
        return
    both = ET.SubElement(shape, "bsdf", type="twosided")
    material = ET.SubElement(both, "bsdf", type="diffuse")
    _value(material, "rgb", "reflectance", albedo)


def _lamp(root: ET.Element, k: int, position: Floats, axis: Floats, radius: float, intensity: float) -> None:
    if radius == 0:
        emitter = ET.SubElement(root, "emitter", type="point", id=f"lamp{k}")
        x, y, z = (_text(v) for v in position)
        ET.SubElement(emitter, "point", name="position", x=x, y=y, z=z)
        _value(emitter, "rgb", "intensity", intensity)
        return
    shape = ET.SubElement(root, "shape", type="disk", id=f"lamp{k}")
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.6 else np.array([0, 1.0, 0])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([radius * u, radius * np.cross(axis, u), axis], axis=1)
    pose[:3, 3] = position
    _transform(shape, pose)
    emitter = ET.SubElement(shape, "emitter", type="area")
    _value(emitter, "rgb", "radiance", intensity / (np.pi * radius**2))


def _surroundings(job: RenderJob, rings: int, sectors: int) -> list[tuple[Patch, float]]:
    """Return what stands around the eye, in its unrotated frame, with albedos: background or region, and lenses."""
    look = job.look
    around = [(_backdrop(look.backdrop_distance_mm), look.backdrop_albedo)]
    if job.region is not None:
        around = _region(job, job.region)
    for k, lens in enumerate(job.eye.worn):
        around += [(patch, 0.0) for patch in lens_patches(lens, f"spectacles_{k}", rings, sectors)]
    return around


def _region(job: RenderJob, spec: Region) -> list[tuple[Patch, float]]:
    """Return parts of the eye region, without its menisci, or of the head mesh, each with its mean albedo."""
    globe = job.globe
    mesh = region_mesh(spec, globe) if spec.head is None else placed(load_head(spec.head), globe)
    skin = spec.skin
    albedo = {"lashes": spec.lashes.albedo, "brow": spec.brow.albedo, "tears": 0.75 * skin.wet_albedo}
    albedo |= {body.part: body.albedo for body in globe.frames if body.part == SPECTACLE_FRAME}
    v, f = ([0, *ends.tolist()] for ends in (mesh.layout.vertex_ends, mesh.layout.face_ends))
    return [
        (
            Patch(
                f"region_{name.replace(' ', '_')}",
                mesh.vertices[v[k] : v[k + 1]],
                mesh.normals[v[k] : v[k + 1]],
                mesh.layout.faces[f[k] : f[k + 1]] - v[k],
            ),
            albedo.get(name, skin.albedo),
        )
        for k, name in enumerate(mesh.parts)
        if f[k + 1] > f[k] and name != OBSTACLE and (spec.head is not None or name != "tears")
    ]


def _film(front: Patch, index: float, sectors: int) -> tuple[Patch, Patch, Patch]:
    """Return the tear film on the front of the cornea, the front below it, and the band between their rims."""
    below = replace(front, vertices=front.vertices - _FILM_MM * front.normals, exterior=index)
    j = np.arange(sectors)
    k = (j + 1) % sectors
    faces = np.concatenate([np.stack([j, j + sectors, k + sectors], 1), np.stack([j, k + sectors, k], 1)])
    edges = np.concatenate([p.vertices[-sectors:] for p in (front, below)])
    rim = Patch("tear_film_rim", edges, np.tile(front.normals[-sectors:], (2, 1)), faces)
    return replace(front, name="tear_film", interior=index), below, rim


def _root(eye: EyeModel, wall: Patch, sectors: int) -> Patch:
    """Compute the limbal tissue in the plane of the iris, from its root to the chamber's wall."""
    (upper, lower), n, c = np.split(wall.vertices, 2), eye.stop.normal, eye.stop.centre_mm
    above, below = ((ring - c) @ n for ring in (upper, lower))
    share = np.clip(above / np.where(above > below, above - below, 1), 0, 1)[:, None]
    outer = upper + share * (lower - upper)
    angle = np.arctan2(outer[:, 2], outer[:, 1])
    y, z = (float(eye.iris_root_radius_mm) * f(angle) for f in (np.cos, np.sin))
    inner = np.stack([c[0] - (n[1] * (y - c[1]) + n[2] * (z - c[2])) / n[0], y, z], axis=1)
    j = np.arange(sectors)
    k = (j + 1) % sectors
    faces = np.concatenate([np.stack([j, j + sectors, k + sectors], 1), np.stack([j, k + sectors, k], 1)])
    vertices = np.concatenate([inner, outer])
    return Patch("iris_root", vertices, np.tile(n, (len(vertices), 1)), faces)


def _backdrop(distance_mm: float) -> Patch:
    h = _BACKDROP_HALF_MM
    corners = np.array([[-distance_mm, y, z] for y, z in ((-h, -h), (h, -h), (h, h), (-h, h))])
    normals = np.tile([1.0, 0.0, 0.0], (4, 1))
    return Patch("backdrop", corners, normals, np.array([[0, 1, 2], [0, 2, 3]]))


def _value(parent: ET.Element, kind: str, name: str, value: float | int | str) -> None:
    ET.SubElement(parent, kind, name=name, value=value if isinstance(value, str) else _text(value))


def _transform(parent: ET.Element, matrix: Floats) -> None:
    transform = ET.SubElement(parent, "transform", name="to_world")
    ET.SubElement(transform, "matrix", value=" ".join(_text(v) for v in np.asarray(matrix).ravel()))


def _text(value: float | int) -> str:
    return str(value) if isinstance(value, int) else f"{float(value):.12g}"
