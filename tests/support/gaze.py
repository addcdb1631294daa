"""Observations and rigs out of plain numbers, and the conversions of the reference vectors' conventions.

`ets` vectors are in metres, in a world whose screen is the plane y = 0 (x to the user's left, z up, the user at y >
0); their cameras look along -z of their own frame, x right and y up, with the principal point at (0, 0). Here that
world becomes (x, y, z) -> (-y, x, z), lengths stay in metres (estimators do not mind the unit), and images are turned
y down.
"""

from __future__ import annotations

import numpy as np

from eyerender.base.arrays import frozen
from eyerender.base.status import Status
from eyerender.rig.camera import PinholeCamera
from eyerender.rig.light import Lamp
from eyerender.rig.rig import RigGeometry
from eyerender.rig.screen import ScreenPlane
from eyerender.scene import Scene, load_scene
from eyerender.scene.observation import GlintFeatures, Index, Observations, PoseTruth, PupilFeatures
from eyerender.scene.spec import SceneSpec


def guestrin(*, corners=False, second_camera=False, eye=None, grid=None):
    """The shipped scene guestrin2006 with the head at rest, and what some estimators need.

    `corners`: four lights at the corners of the screen and one at the camera, instead of its two lights.
    """
    spec = load_scene("guestrin2006", eye=eye).spec.to_mapping()
    spec["subject"]["head_positions_mm"] = [[0.0, 0.0, 0.0]]
    if grid is not None:
        spec["targets"] = {"grid": grid}
    camera, light, screen = spec["rig"]["cameras"][0], spec["rig"]["lights"][0], spec["rig"]["screen"]
    if second_camera:
        spec["rig"]["cameras"].append({**camera, "name": "b", "position_mm": [600, 150, -120]})
    if corners:
        (x, y, z), (w, h) = screen["centre_mm"], screen["size_mm"]
        sides = [(y + w / 2, z + h / 2), (y - w / 2, z + h / 2), (y - w / 2, z - h / 2), (y + w / 2, z - h / 2)]
        places = [[x, *side] for side in sides] + [camera["position_mm"]]
        spec["rig"]["lights"] = [{**light, "position_mm": place} for place in places]
    return Scene.of(SceneSpec.from_mapping(spec), eye=eye)


ETS_TO_WORLD = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# (z away from the user, x to the user's right, y up), the user at z = +658: the one-camera vectors.
PLANE_TO_WORLD = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def observations(pupil, glints, targets=None, *, eye=None, camera=None, fixation=None, frame=None, head=None):
    """A batch of observations: pupil (n, 2), glints (n, m, 2) with NaN where missing, targets (n, 3)."""
    pupil, glints = np.asarray(pupil, dtype=float), np.asarray(glints, dtype=float)
    n, m = glints.shape[:2]
    pupil_ok, glint_ok = np.isfinite(pupil).all(axis=1), np.isfinite(glints).all(axis=2)
    zero = np.zeros(n)
    return Observations(
        index=Index(
            frame=np.arange(n) if frame is None else frame,
            fixation=np.arange(n) if fixation is None else fixation,
            camera=zero if camera is None else camera,
            head=zero,
            eye=zero if eye is None else eye,
            eye_model=np.full(n, "model", dtype=object),
            target_mm=targets,
            head_mm=np.zeros((n, 3)) if head is None else head,
            eye_position_mm=np.zeros((n, 3)),
        ),
        pose=PoseTruth(azimuth_rad=np.full(n, np.nan)),
        pupil=PupilFeatures(
            status=np.where(pupil_ok, Status.OK, Status.NOT_FOUND),
            in_image=pupil_ok,
            centre_px=pupil,
            semi_axes_px=np.full((n, 2), 13.0),
            anatomical_centre_px=pupil,
        ),
        glints=GlintFeatures(
            status=np.where(glint_ok, Status.OK, Status.NOT_FOUND),
            light=np.broadcast_to(np.arange(m), (n, m)),
            in_image=glint_ok,
            xy_px=glints,
        ),
    )


def rig(cameras, lights, screen_centre, size=(400.0, 300.0)):
    lamps = tuple(
        Lamp(position_mm=frozen(p), axis=frozen([1.0, 0, 0]), radius_mm=0.0, intensity_mw_sr=1.0, lobe_exponent=1.0)
        for p in np.asarray(lights, dtype=float)
    )
    screen = ScreenPlane(frozen(screen_centre), frozen([0.0, -1.0, 0.0]), frozen([0.0, 0.0, 1.0]), size)
    return RigGeometry(tuple(cameras), lamps, screen)


def camera_of(trans, focal_px, to_world):
    """A camera of the vectors' convention (4x4 pose, looking along -z, image y up) in this package's."""
    trans = np.asarray(trans, dtype=float)
    R = (to_world @ trans[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
    return PinholeCamera.of(
        [[focal_px, 0, 0], [0, focal_px, 0], [0, 0, 1]], R, -R @ to_world @ trans[:3, 3], (1280, 1024)
    )


def ets_rig(data):
    cameras = [camera_of(c["trans"], c["focal_length_px"], ETS_TO_WORLD) for c in data["cameras"]]
    return rig(cameras, np.array(data["lights"], dtype=float) @ ETS_TO_WORLD.T, (0, 0, 0))


def ets_observations(frames):
    """One observation a frame of the first camera; targets on the screen."""
    images = [f["images"][0] for f in frames]
    down = np.array([1.0, -1.0])
    pupil = np.array([i["pupil_center_px"] for i in images]) * down
    glints = np.array([i["glints_px"] for i in images]) * down
    return observations(pupil, glints, on_plane([f["target"] for f in frames]))


def on_plane(points):
    """Screen points (x, z) of the vectors in this package's world."""
    p = np.asarray(points, dtype=float)
    return np.stack([0 * p[:, 0], p[:, 0], p[:, 1]], axis=-1)
