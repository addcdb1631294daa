"""The catalogue: every value has a source, every file is what it prints, the numbers are those of the table."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.eye.catalogue import FOLDER, catalogue_files, catalogue_names, load_eye
from eyerender.eye.parts import GradientLensSpec
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.eye.spec import EyeSpec
from eyerender.optics.surfaces_graph import Biconic
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.trace import trace

NAMES = ("E1", "E2", "E3", "E4", "E5", "E5-published", "E5-published-stop", "adult", "artificial", "keratoconus")


def test_the_catalogue_is_complete():
    assert catalogue_names() == NAMES
    # Eyes of a study's software are the study's.
    assert sorted(path.stem for path in FOLDER.glob("*.yaml")) == [
        "E1",
        "E2",
        "E3",
        "E4",
        "E5",
        "adult",
        "artificial",
        "keratoconus",
    ]


@pytest.mark.parametrize("name", NAMES)
def test_an_eye_loads_back_as_the_file_it_prints(name, tmp_path):
    spec = load_eye(name)
    spec.dump(tmp_path / "eye.yaml")
    again = EyeSpec.load(tmp_path / "eye.yaml")
    assert again == spec
    assert again.digest() == spec.digest()
    assert again.build() == spec.build()


def leaves(value, path=""):
    """Dotted paths of all numbers."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from leaves(part, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        if value and not any(isinstance(v, dict) for v in value):
            yield path
        else:
            for k, part in enumerate(value):
                yield from leaves(part, f"{path}.{k}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path


@pytest.mark.parametrize("name", NAMES)
def test_every_number_has_a_source_and_every_source_a_number(name):
    data = yaml.safe_load(catalogue_files()[name].read_text())
    sources = data.pop("sources")
    numbers = [path for path in leaves(data) if path != "format"]
    for path in numbers:
        assert any(path == s or path.startswith(s + ".") for s in sources), path
    everything = json.dumps(data)
    for source in sources:
        assert source.split(".")[-1] in everything, source
        assert sources[source].strip()


def test_the_table_of_indices_at_850_nm():
    """The notes' ten digits: half a unit of the last one."""
    eye = load_eye("E5").build()
    assert eye.front_indices == pytest.approx((1.3701734173, 1.3302435786), abs=6e-11)
    assert eye.back_indices[-1] == pytest.approx(1.3304719540, abs=6e-11)
    lens = load_eye("E5").lens
    assert isinstance(lens, GradientLensSpec)
    core, edge = (np.polyval(m.cauchy[::-1], 850.0**-2.0) for m in (lens.core, lens.edge))
    assert edge == pytest.approx(1.3639839821, abs=6e-11)
    assert core == pytest.approx(1.42185945, abs=6e-9)


def test_dispersion_and_constant_media():
    for name, changes in (("E2", False), ("E4", False), ("E5", True)):
        spec = load_eye(name)
        blue, red = spec.build(wavelength_nm=550.0), spec.build(wavelength_nm=850.0)
        assert (blue.front_indices != red.front_indices) is changes
        assert (np.asarray(blue.front_indices) >= np.asarray(red.front_indices)).all()


def test_the_shells_of_a_gradient_lens_follow_its_law():
    """n(p) = n_core - (n_core - n_edge) p^2 at the shells; inside each the mid index; p from the apexes' distances."""
    spec = load_eye("E5")
    assert isinstance(spec.lens, GradientLensSpec)
    built = spec.model_copy(update={"lens": spec.lens.model_copy(update={"shells": 21})}).build()
    core, edge = (np.polyval(m.cauchy[::-1], 850.0**-2.0) for m in (spec.lens.core, spec.lens.edge))
    for eye in (built, spec.build().shelled()):
        assert len(eye.back) == 42
        centre = np.array([-3.6 - 0.4 * 3.5, -0.371 + 0.4 * 0.101, 0.04 + 0.4 * 0.05])
        front, back = eye.back[:21], eye.back[21:][::-1]
        nodes = []
        for half, apex in ((front, [-3.6, -0.371, 0.04]), (back, [-7.1, -0.27, 0.09])):
            whole = np.array(apex) - centre
            size = [np.linalg.norm(s.origin_mm - centre) / np.linalg.norm(whole) for s in half]
            for s, p in zip(half, size, strict=True):
                assert np.allclose(s.origin_mm - centre, p * whole, atol=1e-14)
            law = core - (core - edge) * np.array(size) ** 2
            assert np.allclose(law, np.linspace(edge, core, 22)[:-1], atol=1e-14)
            nodes.append(law)
        middle = 0.5 * (np.append(nodes[0][1:], core) + nodes[0])
        indices = np.array([float(n) for n in eye.back_indices])
        assert np.allclose(indices[:21], middle, atol=1e-14)
        assert np.allclose(indices[21:41], middle[-2::-1], atol=1e-14)
        # Scaled with the shell: the radius, not the conic constant. The apex radius is the half gradient over A_yy.
        for s in front:
            assert isinstance(s, Quadric)
            p = np.linalg.norm(s.origin_mm - centre) / np.linalg.norm(front[0].origin_mm - centre)
            assert s.vector[0] == pytest.approx(14.304 * p, rel=1e-13)
            assert s.matrix[0, 0] == pytest.approx(1.0 - 3.546, rel=1e-13)
    # The gradient itself is not made of shells, and the eye is the same but for its lens.
    eye = spec.build()
    assert len(eye.back) == 2
    assert eye.back_indices == pytest.approx((edge, built.back_indices[-1]), abs=1e-14)
    assert float(eye.lens_gradient.core) == pytest.approx(core, abs=1e-14)
    assert load_eye("E4").build().shelled() == load_eye("E4").build()


def test_corneas_and_stops_stand_where_the_table_says():
    for name, front, back, depth in (("E1", 8.0, None, 3.6), ("E4", 7.72, 6.5, 3.6)):
        eye = load_eye(name).build()
        apex = eye.front[0].to_eye([float(eye.front[0].sag(0.0, 0.0)), 0.0, 0.0])
        assert np.allclose(apex, 0.0, atol=1e-15)
        h = 1e-3
        assert h * h / (2 * -float(eye.front[0].sag(h, 0.0))) == pytest.approx(front, rel=1e-6)
        assert (back is None) == (len(eye.front) == 1)
        assert eye.stop.centre_mm[0] == -depth
        assert eye.stop.semi_axes_mm.tolist() == [2.0, 2.0]
    e5 = load_eye("E5").build()
    biconic = e5.front[0]
    assert isinstance(biconic, Biconic)
    assert biconic.radii_mm.tolist() == [7.76, 7.74]
    assert biconic.conic_constants.tolist() == [-0.272, -0.361]
    assert e5.rotation.azimuth_centre_mm.tolist() == [-14.7, 0.79, 0.0]
    assert e5.rotation.elevation_centre_mm.tolist() == [-12.0, 0.0, 0.33]


@pytest.mark.parametrize("name", NAMES)
def test_the_left_eye_is_the_mirror_image(name):
    """Mirrored rays stay mirrored, through every surface to the retina; so do all landmarks."""
    from eyerender.eye.landmarks import incident_node, path_to_retina

    right, left = load_eye(name).build(), load_eye(name).build(eye="left")
    mirror = np.array([1.0, -1.0, 1.0])
    rng = np.random.default_rng(0)
    aim = np.column_stack([np.full(60, -3.6), rng.uniform(-1.5, 1.5, (60, 2))])
    start = np.array([300.0, 40.0, -60.0]) + rng.normal(size=(60, 3)) * 20.0
    way = (aim - start) / np.linalg.norm(aim - start, axis=1, keepdims=True)
    one = trace(path_to_retina(right), 1.0, start, way)
    other = trace(path_to_retina(left), 1.0, start * mirror, way * mirror)
    assert (one.status == Status.OK).all()
    assert np.allclose(other.points_mm, one.points_mm * mirror, atol=1e-11)
    for a, b in (
        (left.fovea_mm, right.fovea_mm),
        (incident_node(left), incident_node(right)),
        (left.stop.boundary(9), right.stop.boundary(9)),
        (left.chief_ray.direction, right.chief_ray.direction),
        (left.sclera.centre_mm, right.sclera.centre_mm),
        (left.rotation.azimuth_centre_mm, right.rotation.azimuth_centre_mm),
    ):
        assert np.allclose(a, b * mirror, atol=1e-14)


@pytest.mark.parametrize("name", NAMES)
def test_the_sclera_passes_through_the_limbus(name):
    eye = load_eye(name).build()
    angle = np.linspace(0.0, 2 * np.pi, 37)
    y, z = eye.limbus_radius_mm * np.cos(angle), eye.limbus_radius_mm * np.sin(angle)
    rim = eye.front[0].to_eye(np.column_stack([eye.front[0].sag(y, z), y, z]))
    # A biconic's rim is not plane: half of its unevenness is allowed.
    uneven = np.ptp(eye.front[0].sag(y, z))
    assert np.abs(np.linalg.norm(rim - eye.sclera.centre_mm, axis=1) - 12.0).max() <= 0.6 * uneven + 1e-12


@pytest.mark.parametrize("name", NAMES)
def test_eyes_are_values(name):
    eye = load_eye(name).build()
    twin = pickle.loads(pickle.dumps(eye))
    assert twin == eye
    assert hash(twin) == hash(eye)
    assert repr(twin) == repr(eye)
    assert eye != load_eye(name).build(eye="left")
    assert eye != load_eye(name).build(pupil_diameter_mm=3.0)
    with pytest.raises(ValueError, match="read-only"):
        eye.fovea_mm[0] = 0.0


def test_unknown_names_are_refused_with_the_catalogue():
    with pytest.raises(InputError, match="E1, E2, E3"):
        load_eye("E9")
    with pytest.raises(InputError, match="no such file"):
        load_eye("nowhere.yaml")


@pytest.mark.parametrize(("surface", "height", "radius", "q"), [(0, 0.032, 7.72, -0.26), (1, 0.1, 6.5, 0.0)])
def test_the_keratoconus_is_a_cone_on_the_cornea_of_e4(surface, height, radius, q):
    """The expansion of order 10 has the Gaussian cone within 2 % inside the zone, whose blend starts at 3.4 mm."""
    cornea = load_eye("keratoconus").build().front[surface]
    y, z = np.meshgrid(*[np.linspace(-3.0, 3.0, 41)] * 2)
    y, z = (v[np.hypot(y, z) < 3.0] for v in (y, z))
    conic = Quadric.conic(radius, q, cornea.origin_mm, cornea.rotation)

    def cone(y, z):
        return height * np.exp(-((y + 0.85) ** 2 + (z + 0.85) ** 2) / (2 * 1.2**2))

    wanted = conic.sag(y, z) + cone(y, z) - cone(0.0, 0.0)
    assert np.abs(cornea.sag(y, z) - wanted).max() < 0.02 * height


def test_the_artificial_eye_shows_its_stop_where_it_is():
    """No refraction: the outline in the image is the stop's own, projected, and the line of sight is the axis."""
    camera = er.Camera.looking_at((0, -31.5, 0), position_mm=(60, -20, -25), focal_length_px=800, size_px=(640, 480))
    rig = er.Rig(cameras=(camera,), lights=(er.Led((60, -40, -25)),))
    frames = er.Subject.one_eye(er.Eye("artificial"), at_mm=(0, -31.5, 0)).looking([(-12, 9)], rig)
    seen, eye = er.trace(frames, boundary_points=24), frames.scene.eye("right")
    turn, shift = rigid_motion(Poses(frames.pose.azimuth_rad, frames.pose.elevation_rad, frames.pose.torsion_rad), eye)
    stop = eye.stop.boundary(24) @ turn[0].T + shift[0] + [0, -31.5, 0]
    pixels, _ = frames.scene.rig.cameras[0].project(stop[None])
    assert seen.pupil.points_px == pytest.approx(pixels, abs=1e-6)
    assert turn[0] @ eye.chief_ray.direction == pytest.approx(turn[0][:, 0], abs=1e-12)
    assert er.eye.kappa_deg(eye) == pytest.approx((0.0, 0.0), abs=1e-9)
