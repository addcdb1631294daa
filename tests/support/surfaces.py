"""Surfaces of the reference vectors."""

from __future__ import annotations

import numpy as np

from eyerender.optics.surfaces_quadric import Quadric


def quadric_of(row, sign):
    """A row [A B C D E F G H I K ...] of the reference: A x^2 + ... + 2 D xy + ... + 2 G x + ... + K."""
    a, b, c, d, e, f, g, h, i, k = row[:10]
    matrix = np.array([[a, d, e], [d, b, f], [e, f, c]]) / b
    return Quadric.oriented(matrix, np.array([g, h, i]) / b, k / b, sign)


def centre_of(quadric):
    """Centre -A^-1 b, where the gradient vanishes, in the eye frame (..., 3).

    Raises:
        LinAlgError: a paraboloid or plane has no centre.
    """
    local = -np.linalg.solve(quadric.matrix, quadric.vector[..., None])[..., 0]
    return quadric.to_eye(local)
