"""Zernike polynomials, orthonormal on the unit disc, in the standard order of OSA/ANSI Z80.28.

Term j has the radial order n and the azimuthal order m, j = (n (n + 2) + m) / 2, and

    Z = sqrt((2 - delta_m0) (n + 1)) R_n^|m|(rho) cos(m theta), sin(|m| theta) for m < 0,
    R_n^m(rho) = (-1)^k rho^m P_k^(m, 0)(1 - 2 rho^2), k = (n - m) / 2, with Jacobi's polynomials P

(Thibos et al. 2002, "Standards for reporting the optical aberrations of eyes"; Abramowitz & Stegun 22.5). theta runs
from the first axis towards the second. A sum of terms is evaluated as a sum of products of Chebyshev polynomials T_i(p)
T_j(q): its coefficients are no larger than those of the Zernike terms, so no digits cancel, as they do in powers of p
and q. Derivatives are sums of the same products.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev
from scipy.special import eval_jacobi

from ..base.arrays import Floats

MAX_ORDER = 14


def terms(order: int) -> int:
    """Return the number of terms up to a radial order."""
    return (order + 1) * (order + 2) // 2


def order_of(count: int) -> int:
    """Return the smallest radial order with at least `count` terms."""
    order = 0
    while terms(order) < count:
        order += 1
    return order


def orders(order: int) -> list[tuple[int, int]]:
    """Return (n, m) of all terms up to a radial order, in the standard order."""
    return [(n, m) for n in range(order + 1) for m in range(-n, n + 1, 2)]


def zernike(order: int, p: Floats, q: Floats) -> Floats:
    """Evaluate all terms up to a radial order at points (p, q) of the unit disc, (terms, ...)."""
    square, angle = p * p + q * q, np.arctan2(q, p)
    rho = np.sqrt(square)
    out = np.empty((terms(order), *np.shape(square)))
    for j, (n, m) in enumerate(orders(order)):
        a = abs(m)
        k = (n - a) // 2
        radial = (-1.0) ** k * rho**a * eval_jacobi(k, a, 0, 1.0 - 2.0 * square)
        wave = np.cos(a * angle) if m >= 0 else np.sin(a * angle)
        out[j] = np.sqrt((n + 1.0) * (1.0 if m == 0 else 2.0)) * radial * wave
    return out


def mirrored(coefficients: Floats) -> Floats:
    """Mirror coefficients (..., k) of a sum in the second axis, p -> -p: theta becomes pi - theta."""
    signs = [(-1.0) ** m if m >= 0 else -((-1.0) ** m) for _, m in orders(order_of(coefficients.shape[-1]))]
    return np.asarray(coefficients * np.array(signs[: coefficients.shape[-1]]))


@lru_cache(maxsize=MAX_ORDER + 1)
def products(order: int) -> Floats:
    """Compute the matrices from Zernike coefficients to those of Chebyshev products, (6, terms, terms).

    The first axis holds the value and its derivatives by p, q, pp, pq and qq. A product T_i(p) T_j(q) has the index of
    the pair (i, j) in `pairs`.
    """
    count = order + 1
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    p, q = np.meshgrid(nodes, nodes, indexing="ij")
    # A polynomial of this order is the interpolant through its values at the Gauss-Chebyshev nodes.
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, order))
    values = np.einsum("ia,jb,kab->kij", inverse, inverse, zernike(order, p, q))
    rows, columns = np.array(pairs(order)).T

    def derived(times_p: int, times_q: int) -> Floats:
        part = chebyshev.chebder(values, times_p, axis=1) if times_p else values
        part = chebyshev.chebder(part, times_q, axis=2) if times_q else part
        whole = np.zeros_like(values)
        whole[:, : part.shape[1], : part.shape[2]] = part
        return np.asarray(whole[:, rows, columns].T)

    table = np.stack([derived(*by) for by in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))])
    table.setflags(write=False)
    return table


@lru_cache(maxsize=MAX_ORDER + 1)
def pairs(order: int) -> tuple[tuple[int, int], ...]:
    """Return the pairs (i, j) with i + j <= order."""
    return tuple((i, j) for i in range(order + 1) for j in range(order + 1 - i))


def at_middle(order: int) -> Floats:
    """Evaluate the products T_i(0) T_j(0) of `pairs`, (terms,)."""
    value = np.cos(0.5 * np.pi * np.arange(order + 1)).round()
    return np.array([value[i] * value[j] for i, j in pairs(order)])


def fitted(order: int, p: Floats, q: Floats, values: Floats) -> Floats:
    """Fit coefficients (terms,) to values (n,) at points (n,) by least squares."""
    return np.asarray(np.linalg.lstsq(zernike(order, p, q).T, values, rcond=None)[0], dtype=np.float64)
