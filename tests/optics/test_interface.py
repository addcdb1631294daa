"""Formulas in all array libraries, reflection, refraction, Fresnel, and the diffusion of light in tissue."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
from scipy import integrate

from eyerender.backends.choose import choose_backend
from eyerender.base.arrays import Floats
from eyerender.optics import diffusion
from eyerender.optics import formulas as source
from eyerender.optics.formula_kernels import SCALAR_OPS, inlined
from eyerender.optics.formulas import NUMPY, Bend, Formulas, Ops, formulas
from eyerender.optics.interface import fresnel
from eyerender.optics.media import TEARS, CauchyMedium, ConstantMedium
from eyerender.optics.surfaces import components, join
from eyerender.optics.transforms import normalize
from tests.support.paths import load
from tests.support.photons import photons


def rays(seed=0, count=500):
    rng = np.random.default_rng(seed)
    return normalize(rng.normal(size=(count, 3))), normalize(rng.normal(size=(count, 3)))


def test_refraction_keeps_the_tangential_component_of_n_times_direction():
    """n1 d x N = n2 w x N, whichever way N points."""
    d, normal = rays()
    for n1, n2 in ((1.0, 1.3375), (1.42, 1.336), (1.5, 1.0)):
        bent = NUMPY.refract(components(d), components(normal), n1 / n2)
        w, passes = join(bent.way), bent.passes
        assert np.allclose(np.linalg.norm(w, axis=1)[passes], 1.0, atol=1e-14)
        assert np.allclose(n1 * np.cross(d, normal)[passes], n2 * np.cross(w, normal)[passes], atol=1e-14)
        assert (np.sign(np.sum(d * normal, 1)) == np.sign(np.sum(w * normal, 1)))[passes].all()
        sine = n1 * np.linalg.norm(np.cross(d, normal), axis=1)
        assert (passes == (sine < n2)).all()


def test_a_refracted_ray_runs_back_the_way_it_came():
    d, normal = rays(1)
    bent = NUMPY.refract(components(d), components(normal), 1.0 / 1.376)
    w = bent.way
    back = NUMPY.refract((-w[0], -w[1], -w[2]), components(normal), 1.376).way
    assert bent.passes.all()
    # Near grazing the square root of a small number doubles the digits lost.
    assert np.allclose(join(back), -d, atol=1e-12)


def test_reflection_turns_the_normal_component_round():
    d, normal = rays(2)
    w = join(NUMPY.reflect(components(d), components(normal)).way)
    assert np.allclose(np.sum(w * normal, 1), -np.sum(d * normal, 1), atol=1e-14)
    assert np.allclose(np.cross(w, normal), np.cross(d, normal), atol=1e-14)


def test_fresnel_shares_add_up_to_one_with_the_transmitted_amplitudes():
    """R + T = 1 with T from the transmission coefficients (Born & Wolf 1.5.2 eq. 20), an independent formula."""
    angle = np.random.default_rng(3).uniform(0.0, np.pi / 2 - 1e-3, 200)
    for n1, n2 in ((1.0, 1.376), (1.376, 1.336), (1.336, 1.0)):
        inside = angle[n1 * np.sin(angle) < n2 * 0.999999]
        refracted = np.arcsin(n1 * np.sin(inside) / n2)
        shares = fresnel(np.cos(inside), n1, n2)
        t_s = 2 * n1 * np.cos(inside) / (n1 * np.cos(inside) + n2 * np.cos(refracted))
        t_p = 2 * n1 * np.cos(inside) / (n2 * np.cos(inside) + n1 * np.cos(refracted))
        area = n2 * np.cos(refracted) / (n1 * np.cos(inside))
        assert np.allclose(shares.s + area * t_s**2, 1.0, atol=1e-12)
        assert np.allclose(shares.p + area * t_p**2, 1.0, atol=1e-12)
        assert np.allclose(shares.unpolarized, 0.5 * (shares.s + shares.p), atol=1e-15)


def test_fresnel_at_normal_incidence_brewster_and_total_reflection():
    assert fresnel(1.0, 1.0, 1.376).unpolarized == pytest.approx((0.376 / 2.376) ** 2, abs=1e-15)
    assert fresnel(np.cos(np.arctan(1.376)), 1.0, 1.376).p == pytest.approx(0.0, abs=1e-30)
    assert fresnel(np.cos(np.radians(60.0)), 1.376, 1.0).unpolarized == 1.0


def test_a_film_adds_up_what_bounces_in_it():
    """Intensities of a pile of two plates, summed bounce by bounce; and the same from either side (Stokes)."""
    angle = np.linspace(0.0, 1.5, 50)
    film, behind = 1.3314, 1.376
    shares = fresnel(np.cos(angle), 1.0, behind, film)
    in_film, inside = np.arcsin(np.sin(angle) / film), np.arcsin(np.sin(angle) / behind)
    for k in (0, 1):
        first, second = fresnel(np.cos(angle), 1.0, film)[k], fresnel(np.cos(in_film), film, behind)[k]
        bounces = sum(second * (first * second) ** n for n in range(8))
        assert np.allclose(shares[k], first + (1 - first) ** 2 * bounces, atol=1e-14)
        assert np.allclose(fresnel(np.cos(inside), behind, 1.0, film)[k], shares[k], atol=1e-12)
    assert fresnel(np.cos(1.2), behind, 1.0, film).unpolarized == 1.0
    assert np.allclose(fresnel(np.cos(angle), 1.0, behind, behind), fresnel(np.cos(angle), 1.0, behind), atol=1e-15)
    assert 0.81 < shares.unpolarized[0] / fresnel(1.0, 1.0, behind).unpolarized < 0.84


def test_the_index_of_tears():
    # Water at 24 deg C has 1.33299 at 589.3 nm (Daimon and Masumura) and 1.3274 at 850 nm.
    assert TEARS.index(589.3) == pytest.approx(1.337, abs=1e-4)
    assert TEARS.index(589.3) - TEARS.index(850.0) == pytest.approx(0.00556, abs=2e-5)


def test_indices_agree_with_the_reference():
    """To 1e-10, the reference's own digits being exact; rounding is near 1e-15."""
    data = load("refractive_index.json")
    count = 0
    for name, table in data["values"].items():
        if name not in data["coefficients"]:
            continue
        medium = CauchyMedium(*data["coefficients"][name])
        for wavelength, index in table.items():
            assert medium.index(float(wavelength)) == pytest.approx(index, abs=1e-10)
            count += 1
    assert count >= 40


def test_a_constant_medium_is_the_same_at_every_wavelength():
    assert ConstantMedium(1.3375).index(400.0) == ConstantMedium(1.3375).index(940.0) == 1.3375


AT_MM = np.linspace(-3.0, 3.0, 61)


def edge(at_mm: np.ndarray, length_mm: float) -> np.ndarray:
    """Light at places of a surface that is lit where x > 0 only, by the profile R(r): integrated over half planes."""
    r = np.geomspace(1e-4, 80.0, 4001)
    share = np.append(0.0, diffusion.share_within(r))
    r = np.append(0.0, r)
    middle, weight = 0.5 * (r[1:] + r[:-1]) * length_mm, np.diff(share)
    lit = 0.5 + np.arcsin(np.clip(at_mm[:, None] / middle, -1, 1)) / np.pi  # of each ring
    return lit @ weight


def test_the_profile_holds_all_light_and_its_shares_are_integrals():
    def profile(r):
        return (np.exp(-r) + np.exp(-r / 3)) / (8 * np.pi * r)

    for radius in (0.2, 1.0, 4.0):
        share, _ = integrate.quad(lambda r: 2 * np.pi * r * profile(r), 0, radius)
        assert float(diffusion.share_within(radius)) == pytest.approx(share, rel=1e-8)
        assert diffusion.radius_of(share) == pytest.approx(radius, rel=1e-8)
    assert float(diffusion.share_within(80.0)) == pytest.approx(1.0, abs=1e-11)


@pytest.mark.parametrize("absorption", [0.04, *(pytest.param(a, marks=pytest.mark.slow) for a in (0.02, 0.08))])
def test_shadow_edges_on_skin_agree_with_photons(absorption):
    found = photons(100_000, 2.04, absorption)
    length = diffusion.half_space_length_mm(found.reflectance, 2.04)
    # The fit is good to 0.016, and 100,000 photons leave 0.003.
    assert np.abs(edge(AT_MM, length) - found.edge(AT_MM)).max() < 0.02


@pytest.mark.parametrize(
    ("thickness", "scattering"),
    [(0.8, 2.5), pytest.param(0.6, 2.0, marks=pytest.mark.slow), pytest.param(1.0, 3.0, marks=pytest.mark.slow)],
)
def test_shadow_edges_on_the_sclera_agree_with_photons(thickness, scattering):
    found = photons(100_000, scattering, 0.03, thickness=thickness, below=0.1)
    length = diffusion.slab_length_mm(found.reflectance, scattering)
    assert np.abs(edge(AT_MM, length) - found.edge(AT_MM)).max() < 0.02


@pytest.mark.parametrize(
    ("absorption", "thickness"),
    [(0.033, 2.6), pytest.param(0.02, 2.0, marks=pytest.mark.slow), pytest.param(0.08, 1.5, marks=pytest.mark.slow)],
)
def test_lids_transmit_as_photons_do(absorption, thickness):
    albedo = photons(40_000, 2.04, absorption).reflectance
    passed = photons(40_000, 2.04, absorption, thickness=thickness).passed
    # An exponential fits thicknesses of 0.5 to 3.5 mm within 8 %.
    assert np.exp(-diffusion.transmitted(albedo, 2.04) * thickness) == pytest.approx(passed, rel=0.08)


COUNT = 64


def _jet(library: Formulas) -> Callable[..., Any]:
    jet = library.biconic_jet

    def run(a: Any, b: Any) -> Any:
        return jet((0.128, 0.131, 0.013, 0.015), a[0], a[1])

    return run


def _refraction(library: Formulas) -> Callable[..., Any]:
    refract = library.refract

    def run(a: Any, b: Any) -> Any:
        return refract(a, b, 1.0 / 1.376, 0.0).way

    return run


def _fresnel(library: Formulas) -> Callable[..., Any]:
    refract, fresnel, film = library.refract, library.fresnel, library.fresnel_film

    def run(a: Any, b: Any) -> Any:
        bend = refract(a, b, 1.0 / 1.376, 0.0)
        return fresnel(bend.cosine, bend.behind, 1.0 / 1.376) + film(bend.cosine, bend.behind, 1.0 / 1.376, 1.0 / 1.337)

    return run


def _differential(library: Formulas) -> Callable[..., Any]:
    refract, slide, differential = library.refract, library.slide, library.bend_differential

    def run(a: Any, b: Any) -> Any:
        bend = refract(a, b, 1.0 / 1.376, 0.0)
        move = slide((0.1, 0.2, -0.3), a, b, bend.cosine)
        return differential(bend, a, b, 0.9, (0.1 * move[0], 0.13 * move[1], 0.12 * move[2]), (0.02, -0.1, 0.05))

    return run


CASES = {"biconic": _jet, "refraction": _refraction, "fresnel": _fresnel, "differential": _differential}


def _vectors(seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    out = rng.uniform(-1.0, 1.0, (3, COUNT))
    out[0] = np.sign(seed - 0.5) * (1.0 + np.abs(out[0]))
    return np.asarray(out / np.linalg.norm(out, axis=0))


WAY, NORMAL = _vectors(0), _vectors(1)


def _with_numpy(case: Callable[[Formulas], Callable[..., Any]]) -> Floats:
    parts = case(formulas(_numpy_ops()))(tuple(WAY), tuple(NORMAL))
    return np.stack(np.broadcast_arrays(*parts))


def _numpy_ops() -> Ops:
    root = source.continued
    return Ops(sqrt=np.sqrt, root=root, maximum=np.maximum, copysign=np.copysign, select=np.where)


def _with_numba(case: Callable[[Formulas], Callable[..., Any]]) -> Floats:
    run = numba.njit(error_model="numpy")(case(formulas(Ops(root=np.sqrt, **SCALAR_OPS))))
    return np.array([run(tuple(WAY[:, k]), tuple(NORMAL[:, k])) for k in range(COUNT)]).T


def _with_drjit(case: Callable[[Formulas], Callable[..., Any]]) -> Floats:
    choose_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    ops = Ops(sqrt=dr.sqrt, root=dr.sqrt, maximum=dr.maximum, copysign=dr.copysign, select=dr.select)
    a, b = (mi.Vector3f(*(mi.Float(row.astype(np.float32)) for row in vector)) for vector in (WAY, NORMAL))
    parts = [mi.Float(part) for part in case(formulas(ops))(a, b)]
    return np.stack(np.broadcast_arrays(*(part.numpy() for part in parts)))


@pytest.mark.parametrize("name", CASES)
def test_numpy_and_numba_agree_to_the_bit(name):
    assert np.array_equal(_with_numpy(CASES[name]), _with_numba(CASES[name]))


@pytest.mark.render
@pytest.mark.parametrize("name", CASES)
def test_drjit_agrees_to_single_precision(name):
    assert np.abs(_with_drjit(CASES[name]) - _with_numpy(CASES[name])).max() < 2e-6  # 16 roundings of numbers of 1


def _twice_the_height(ops: Ops) -> Callable[..., Any]:
    def height(numerator: Any, linear: Any, square: Any) -> Any:
        return source.Jet(2.0 * numerator.x, 0.0, 0.0, 0.0, 0.0, 0.0)

    return ops.compile(height)


def _not_bent(ops: Ops) -> Callable[..., Any]:
    inner = source.dot(ops)

    def refract(way: Any, normal: Any, eta: Any, least: float = 0.0) -> Any:
        cosine = -inner(way, normal)
        return Bend((way[0], way[1], way[2]), cosine, 0.5 * cosine, 1.0, 0.0, 0.0, cosine == cosine)

    return ops.compile(refract)


def _half_as_bright(ops: Ops) -> Callable[..., Any]:
    def fresnel(c1: Any, c2: Any, eta: Any) -> Any:
        return 0.5 * c1, 0.25 * c2

    return ops.compile(fresnel)


def _only_scaled(ops: Ops) -> Callable[..., Any]:
    def bend(bend: Any, way: Any, normal: Any, inverse: Any, curve: Any, turn: Any) -> Any:
        return 3.0 * way[0] + curve[0], curve[1], curve[2]

    return ops.compile(bend)


CHANGED = {
    "biconic": ("sheet", _twice_the_height),
    "refraction": ("refraction", _not_bent),
    "fresnel": ("fresnel", _half_as_bright),
    "differential": ("differential", _only_scaled),
}


@pytest.mark.render
@pytest.mark.parametrize("name", CASES)
def test_a_changed_formula_changes_all_three(name, monkeypatch):
    before = _with_numpy(CASES[name])
    monkeypatch.setattr(source, *CHANGED[name])
    after = _with_numpy(CASES[name])
    assert np.abs(after - before).max() > 0.01
    assert np.array_equal(after, _with_numba(CASES[name]))
    assert np.abs(after - _with_drjit(CASES[name])).max() < 2e-6


def test_zernike_and_spline_of_numpy_and_numba_agree():
    rng = np.random.default_rng(3)
    table, near = rng.normal(size=(6, 15)), rng.normal(size=(4, 4))

    def both(library: Formulas) -> Callable[..., Any]:
        zernike, bicubic, splines = library.zernike_jet, library.bicubic_jet, library.cubic_splines

        def run(table: Any, near: Any, p: Any, q: Any) -> Any:
            return zernike(table, 4, p, q), bicubic(near, splines(p), splines(q), 4.0)

        return run

    fast = inlined(both(formulas(Ops(root=np.sqrt, **SCALAR_OPS))))
    compiled = numba.njit(lambda table, near, p, q: fast(table, near, p, q))
    p, q = rng.uniform(size=(2, COUNT))
    arrays = both(NUMPY)(table, near, p, q)
    for k in range(COUNT):
        for one, all_ in zip(compiled(table, near, p[k], q[k]), arrays, strict=True):
            assert np.array_equal(np.array(one), np.array(all_)[:, k])
