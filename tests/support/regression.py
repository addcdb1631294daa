"""Features whose regression is known exactly."""

from __future__ import annotations

import numpy as np

from eyerender.base.status import Status
from eyerender.rig.rig import Rig
from eyerender.scene.observation import GlintFeatures, Index, Observations, PoseTruth, PupilFeatures

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
    xy = np.stack([glint[k % 2] for k in range(n)])[:, None]
    return Observations(
        index=Index(
            frame=np.arange(n) // 2,
            fixation=np.arange(n) // 2,
            camera=np.zeros(n, int),
            head=np.zeros(n, int),
            eye=np.arange(n) % 2,
            eye_model=np.full(n, "E2", dtype=object),
            target_mm=targets,
            head_mm=np.zeros((n, 3)),
            eye_position_mm=np.zeros((n, 3)),
        ),
        pose=PoseTruth(azimuth_rad=np.full(n, np.nan)),
        pupil=PupilFeatures(
            status=np.full(n, Status.OK),
            in_image=np.ones(n, bool),
            centre_px=centre,
            semi_axes_px=np.full((n, 2), 13.0),
            angle_rad=np.zeros(n),
            anatomical_centre_px=centre,
        ),
        glints=GlintFeatures(
            status=np.full((n, 1), Status.OK), light=np.zeros((n, 1), int), in_image=np.ones((n, 1), bool), xy_px=xy
        ),
    )
