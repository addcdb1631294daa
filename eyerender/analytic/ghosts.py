"""Ghost glints: lamps that the cornea mirrors, seen by way of the back of a mirror's glass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.arrays import Floats, Indices, Statuses
from ..base.status import Status, mark
from ..eye.batch import CHUNK_POINTS, chunks, groups
from ..eye.model import EyeModel
from ..eye.pose import Poses
from ..optics.surfaces import Xyz
from ..rig.rig import RigGeometry
from ..scene.observation import GlintFeatures, Index, PoseTruth
from .features import RigidMotions, View, rows_of
from .rays import glint_exits

_STEPS = 8  # each reduces the error by the ratio of the glass's thickness to the distance, a tenth at most


def ghost_glint_features(
    rig: RigGeometry,
    eyes: Sequence[EyeModel],
    which: Indices,
    index: Index,
    pose: PoseTruth,
    rig_motion: RigidMotions | None = None,
) -> GlintFeatures | None:
    """Compute the ghost of each glint, for cameras whose mirror has one; None if no mirror has."""
    numbers = [k for k, camera in enumerate(rig.cameras) if camera.mirror is not None and camera.mirror.has_ghosts]
    if not numbers:
        return None
    n, m = len(which), len(rig.lights)
    status, xy = np.full((n, m), Status.NONE, np.int8), np.full((n, m, 2), np.nan)
    inside, lights = np.zeros((n, m), dtype=bool), np.array([light.position_mm for light in rig.lights])
    place = index.eye_position_mm + index.head_mm
    for group, rows in groups(eyes, which):
        for number in numbers:
            camera = rig.cameras[number]
            own = rows[index.camera[rows] == number]
            for block, eye in chunks(group, own, CHUNK_POINTS // 4) if len(own) else ():
                turn = Poses(pose.azimuth_rad[block], pose.elevation_rad[block], pose.torsion_rad[block])
                view = View.of(eye, turn, place[block], camera, rows_of(rig_motion, block))
                for k in range(m):
                    xy[block, k], status[block, k] = _seen(view, eye, lights[k : k + 1])
                inside[block] = camera.in_image(xy[block])
    unlit = ~rig.lit(index.eye)
    status[unlit], xy[unlit], inside[unlit] = Status.NONE, np.nan, False
    reason = np.full((n, m), None, dtype=object)
    for i, j in np.argwhere(status > Status.OK):
        reason[i, j] = Status(status[i, j]).reason
    light = np.where(status == Status.NONE, -1, np.arange(m))
    return GlintFeatures(status=status, light=light, reason=reason, in_image=inside & (status == Status.OK), xy_px=xy)


def _seen(view: View, eye: EyeModel, light_mm: Floats) -> tuple[Floats, Statuses]:
    """Compute the ghost (n, 2) px of one light (1, 3) mm in each view, and its status (n,)."""
    camera, node = view.camera, view.camera_mm
    assert camera.mirror is not None
    lamp = view.into_eye(light_mm)
    for _ in range(_STEPS):
        exits, _, status = glint_exits(eye, 1, lamp, node, view.lenses)
        seen = np.einsum("nij,jn->ni", view.rotation, np.stack(exits)[..., 0]) + view.translation
        away = camera.mirror.ghost_node(seen)
        node = _into_eye(view, away)
    found, way = status[:, 0].copy(), seen - away
    mark(found, ~camera.mirror.holds(way), Status.BESIDE_MIRROR)
    x, y, front = camera.plane(way)
    mark(found, ~front, Status.BEHIND_CAMERA)
    return np.where((found == Status.OK)[:, None], camera.pixels_of(x, y), np.nan), found


def _into_eye(view: View, points: Floats) -> Xyz:
    """Transform points (n, 3) of the camera's frame into each eye's."""
    x, y, z = np.einsum("nij,ni->jn", view.rotation, np.nan_to_num(points) - view.translation)
    return x, y, z
