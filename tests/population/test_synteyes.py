"""SyntEyes: the eye in the tests of visisipy, the mixture's spread, and files that are none."""

from __future__ import annotations

import zipfile
from dataclasses import replace

import numpy as np
import pytest

from eyerender.analytic.features import features
from eyerender.base.errors import InputError
from eyerender.eye.catalogue import load_eye
from eyerender.eye.kappa import kappa_deg, pupillary_axis, with_kappa
from eyerender.eye.pose import Poses
from eyerender.optics.solve import apparent_points
from eyerender.population.synteyes import SyntEyes
from tests.eye.test_corneas import LIGHTS, camera
from tests.support.corneas import GOLDEN, GOLDEN_BACK, GOLDEN_LENS
from tests.support.mirror import mirror_points

# Biometry of the eye in visisipy's tests/test_synteyes.py.
CCT, ACD, LT, AL = 0.5675980419300763, 2.6237068010504445, 4.418377549556682, 24.498505342346316
RLA, RLP, INDEX = 9.57499968358316, -6.3395193068970705, 1.4235768359806096


def power(index, r1, r2, thickness):
    """Power of a thick lens in media of 1.336 (D)."""
    f1, f2 = (index - 1.336) / r1, (1.336 - index) / r2
    return 1e3 * (f1 + f2 - thickness / index * f1 * f2)


def archive(path, **changes):
    """A file like that of visisipy, whose means are that eye; the two components differ in the axial length."""
    rng = np.random.default_rng(0)
    mean = np.array([ACD, LT, AL, RLA, RLP, power(INDEX, RLA, RLP, LT), *np.zeros(12)])
    spread = np.diag([0.1, 0.1, 0.4, 0.3, 0.2, 0.5, *np.full(12, 0.3)]) ** 2
    broken = spread.copy()
    broken[17, 17] = -1e-3
    arrays = {
        "conv_ec_orig": rng.normal(size=(91, 12)) * np.r_[0, np.full(44, 0.3), 0, np.full(44, 0.3), 3.0][:, None],
        "avg_ec_orig": np.array([[*GOLDEN, *GOLDEN_BACK, CCT]]),
        "lens_za_orig": np.array(GOLDEN_LENS),
        "weights_orig": np.array([0.6, 0.4]),
        "mu_orig": np.stack([mean, mean + 1.5 * (np.arange(18) == 2)]),
        "cov_orig0": broken,
        "cov_orig1": spread,
        "mu_retina_radii": np.array([23.85, 11.89, 11.66, 10.55]),
        "cov_retina_radii": np.array(
            [[1.82, 0.56, 0.42, 0.81], [0.56, 0.36, 0.19, 0.18], [0.42, 0.19, 0.24, 0.16], [0.81, 0.18, 0.16, 0.48]]
        ),
    } | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return SyntEyes.load(archive(tmp_path_factory.mktemp("synteyes") / "modeldata.npz"))


def test_the_published_eye_is_built(model):
    """CCT, depths and lens index as published.

    The radii are those of c_4 and c_12 alone, 2 (2 sqrt(3) c_4 - 6 sqrt(5) c_12) / 3.25^2, within the share of the
    terms of order 6 and 8.
    """
    drawn = model.of_latent(model.means[0], np.zeros(3))
    assert drawn.lens_index == pytest.approx(INDEX, abs=1e-9)
    spec = model.eye_file(drawn)
    eye = spec.build()
    assert eye.front[1].origin_mm[0] == pytest.approx(-CCT)
    # The chamber's depth counts from the back of the cornea, and that of an eye file from its front.
    assert eye.back[0].origin_mm[0] == pytest.approx(-(CCT + ACD))
    assert eye.back[1].origin_mm[0] == pytest.approx(-(CCT + ACD + LT))
    assert eye.retina.intersect([[0.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]])[0][0] == pytest.approx(AL - 0.2, abs=1e-9)
    origin = np.zeros(1)
    for surface, radius in ((eye.front[0], 7.941), (eye.front[1], 6.447)):
        jet = surface.jet(origin, origin)
        assert -2.0 / float((jet.yy + jet.zz)[0]) == pytest.approx(radius, rel=0.02)
    seen = features([eye], [0], Poses.from_degrees(3.0, -2.0), np.zeros((1, 3)), [camera()], [0], LIGHTS)
    assert (seen.point_status == 0).all()
    assert (seen.glint_status == 0).all()


def test_the_index_of_the_lens_solves_the_thick_lens(model):
    rng = np.random.default_rng(1)
    for _ in range(20):
        latent = model.means[0] + model.factors[1] @ rng.normal(size=18)
        drawn = model.of_latent(latent, np.zeros(3))
        found = power(drawn.lens_index, drawn.lens_radii_mm[0], drawn.lens_radii_mm[1], drawn.lens_thickness_mm)
        assert found == pytest.approx(drawn.lens_power_d, abs=1e-9)


def test_draws_have_the_spread_of_a_mixture(model):
    """Var = S + w (1 - w) d^2; a weighted sum of both components would have half the standard deviation."""
    drawn = [model._drawn(np.random.default_rng([3, k]), 0) for k in range(4000)]
    lengths = np.array([one.axial_length_mm for one in drawn])
    expected = np.sqrt(0.4**2 + 0.6 * 0.4 * 1.5**2)
    assert np.mean([one.component for one in drawn]) == pytest.approx(0.4, abs=0.03)
    assert lengths.mean() == pytest.approx(AL + 0.4 * 1.5, abs=0.05)
    assert lengths.std() == pytest.approx(expected, rel=0.04)
    axial = np.array([one.retina_mm[2] for one in drawn])
    assert np.polyfit(lengths, axial, 1)[0] == pytest.approx(0.81 / 1.82, abs=0.03)


def test_a_draw_is_a_function_of_seed_and_subject(model):
    one, spec = model.draw(5, seed=2)
    again, same = model.draw(5, seed=2)
    assert spec == same
    assert one.refused == again.refused
    assert spec != model.draw(6, seed=2)[1]
    assert spec != model.draw(5, seed=3)[1]


def test_what_the_model_does_not_know_can_be_given(model):
    _, spec = model.draw(1, pupil_diameter_mm=3.0, limbus_radius_mm=6.1, sclera_radius_mm=11.5, kappa_deg=(4.8, 1.2))
    assert spec.stop.diameter_mm == 3.0
    assert spec.limbus_radius_mm == 6.1
    assert spec.sclera.radius_mm == 11.5
    assert kappa_deg(spec.build()) == pytest.approx((4.8, 1.2), abs=1e-8)


@pytest.mark.parametrize("name", ["E2", "E4", "E5"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_from_the_pupillary_axis_the_glint_lies_on_the_centre_of_the_pupil(name, side):
    """A camera with a lamp at its nodal point, 400 mm away on that axis."""
    eye = load_eye(name).build(eye=side)
    point, way = pupillary_axis(eye)
    place = point + 400.0 * way
    centre = apparent_points(eye.front, eye.front_indices, eye.stop.centre_mm, place)
    glint = mirror_points(eye.front[0], place, place)
    assert np.linalg.norm(centre.exit_points_mm - glint.points_mm) < 1e-8
    assert np.linalg.norm(glint.points_mm - point) < 1e-8


def test_kappa_gives_alpha_by_tracing():
    """The stop of E2 is centred, so its kappa is alpha seen through the pupil: some tenths of a degree away."""
    spec = load_eye("E2")
    horizontal, vertical = kappa_deg(spec.build())
    assert horizontal == pytest.approx(5.45, abs=0.6)
    assert vertical == pytest.approx(2.5, abs=0.4)
    left = kappa_deg(spec.build(eye="left"))
    assert left == pytest.approx((horizontal, vertical), abs=1e-9)
    turned = with_kappa(spec, (3.0, -1.0))
    assert kappa_deg(turned.build()) == pytest.approx((3.0, -1.0), abs=1e-8)
    assert turned.fovea.field_deg[0] == pytest.approx(3.0 * 5.45 / horizontal, abs=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mu_orig": None}, "has no array 'mu_orig'"),
        ({"mu_orig": np.zeros((2, 17))}, "mu_orig: must have the shape"),
        ({"weights_orig": np.array([0.9, 0.9])}, "weights_orig: must be shares"),
        ({"avg_ec_orig": np.full((1, 91), np.nan)}, "avg_ec_orig: holds a value"),
        ({"conv_ec_orig": np.zeros((2000, 200))}, "more than 1048576 bytes"),
        ({"mu_orig": np.array([{"a": 1}], dtype=object)}, "not a NumPy archive that can be read"),
    ],
)
def test_other_files_are_refused_with_one_line(changes, message, tmp_path):
    with pytest.raises(InputError, match=message):
        SyntEyes.load(archive(tmp_path / "modeldata.npz", **changes))


def test_numbers_that_make_no_eye_are_one_line(tmp_path, monkeypatch):
    """Zeros, huge and tiny numbers in place of each array, whole or in one place."""
    monkeypatch.setattr("eyerender.population.synteyes.MAX_REFUSED", 2)  # a hundred draws show no more
    path = tmp_path / "a.npz"
    with np.load(archive(path)) as found:
        arrays = dict(found)
    for name, array in arrays.items():
        for value in (0.0, 1e-300, 1e8, 1e308):
            one = array.copy()
            one.flat[0] = value
            for changed in (np.full_like(array, value), one):
                try:
                    SyntEyes.load(archive(path, **{name: changed})).draw(0)
                except InputError as error:
                    assert "\n" not in str(error)  # noqa: PT017  (some of them are eyes)


@pytest.mark.parametrize("radii", [(0.0, -6.0), (10.0, 0.0), (0.0, 0.0), (1e-300, -1e-300)])
def test_a_lens_without_radii_has_no_index_and_is_refused(model, radii):
    eye, _ = model.draw(0)
    flat = replace(eye, lens_radii_mm=np.array(radii))
    with pytest.raises(InputError):
        model.eye_file(flat)


def test_files_that_are_no_archive_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("nothing")
    with pytest.raises(InputError, match="not a NumPy archive"):
        SyntEyes.load(tmp_path / "text.npz")
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as other:
        other.writestr("a.npy", b"")
    with pytest.raises(InputError, match="has no array"):
        SyntEyes.load(tmp_path / "other.npz")
    with pytest.raises(InputError, match="no such file"):
        SyntEyes.load(tmp_path / "none.npz")
