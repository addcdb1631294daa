"""Features whose regression is known exactly."""

from __future__ import annotations

import numpy as np

from eyerender.arrays import frozen
from eyerender.observation import GlintFeatures, Index, Observations, PoseTruth, PupilFeatures
from eyerender.rig.rig import Rig

RIG = Rig.from_mapping(
    {
        "cameras": [
            {"position_mm": [520, 0, -300], "tilt_deg": 30, "focal_length_px": 3571, "resolution_px": [1600, 1200]}
        ],
        "lights": [{"position_mm": [560, 0, -250]}],
        "screen": {"centre_mm": [800, 0, -131.5], "size_mm": [495, 280]},
    }
).build()  # fmt: skip


def synthetic(columns=5, rows=4, polynomial=None, seed=0):
    """Both eyes' features whose targets are an exact polynomial of the pupil-glint vector."""
    rng = np.random.default_rng(seed)
    u = np.stack(np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows), indexing="ij"), -1).reshape(-1, 2)
    f = len(u)
    glint = {0: np.array([600.0, 500.0]), 1: np.array([975.0, 500.0])}
    separation = 375.0
    v = 0.03 * u + rng.normal(0, 1e-3, u.shape)  # the vector in units of the separation
    centre = np.empty((2 * f, 2))
    for eye in (0, 1):
        # Both eyes get the same vector, so the pupils' separation is that of the glints: exactly the unit.
        centre[eye::2] = glint[eye] + separation * v
    polynomial = polynomial or (lambda x, y: (8000 * x + 300 * x * y, 7000 * y + 20000 * y * y))
    wanted = np.stack(polynomial(v[:, 0], v[:, 1]), axis=-1)
    targets = np.repeat(RIG.screen.world(wanted), 2, axis=0)
    n = 2 * f
    none, ok = np.full(n, None, dtype=object), np.full(n, "ok", dtype=object)
    model = np.full(n, "E2", dtype=object)
    nan = np.full(n, np.nan)
    xy = np.stack([glint[k % 2] for k in range(n)])[:, None]
    return Observations(
        Index(
            frozen(np.arange(n) // 2, np.int64), frozen(np.arange(n) // 2, np.int64), frozen(np.zeros(n), np.int64),
            frozen(np.zeros(n), np.int64), frozen(np.arange(n) % 2, np.int64), frozen(model, object),
            frozen(targets), frozen(np.zeros((n, 3))), frozen(np.zeros((n, 3))),
        ),
        PoseTruth(frozen(nan), frozen(nan), frozen(nan), frozen(nan)),
        PupilFeatures(
            frozen(ok, object), frozen(none, object), frozen(np.ones(n), bool), frozen(centre),
            frozen(np.full((n, 2), 13.0)), frozen(np.zeros(n)), frozen(centre), frozen(np.zeros((n, 0, 2))),
            frozen(np.full((n, 5, 5), np.nan)),
        ),
        GlintFeatures(
            frozen(np.zeros((n, 1)), np.int64), frozen(ok[:, None], object), frozen(none[:, None], object),
            frozen(np.ones((n, 1)), bool), frozen(xy), frozen(np.full((n, 1, 2, 2), np.nan)),
        ),
    )  # fmt: skip
