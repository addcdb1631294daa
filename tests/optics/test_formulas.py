"""One source of the formulas: NumPy, numba and Dr.Jit agree, and a change in the one place changes all three."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

from eyerender.backends.choose import choose_backend
from eyerender.base.arrays import Floats
from eyerender.optics import formulas as source
from eyerender.optics.formula_kernels import SCALAR_OPS, inlined
from eyerender.optics.formulas import NUMPY, Bend, Formulas, Ops, formulas

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
