"""
Your own rig
============

A rig is made of cameras, LEDs and a screen. Here a camera with a ring of LEDs looks at an eye, and one LED is moved.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

camera = er.Camera.looking_at((0, 0, 0), position_mm=(45, -10, -25), focal_length_px=700, size_px=(400, 400))
ring = er.Led(ring=er.LedRing(radius_mm=14, count=8), intensity_mw_sr=2)
rig = er.Rig(cameras=[camera], lights=[ring])

# %%
# Every LED of the ring has a glint. Moving one LED by 4 mm moves one glint; the other LEDs stay where they are.
frames = er.Subject.one_eye(er.Eye("E4")).looking([(0, 0)], rig)
before = er.trace(frames)
after = er.trace(frames, rig.with_light(2, moved_mm=(0, 4, 0)))
moved = np.linalg.norm(after.glints.xy_px - before.glints.xy_px, axis=-1)[0]
print("the glints moved by (px):", moved.round(3))

# %%
# A mistake names what is wrong with it, in one line.
try:
    er.Led((600, 0, 0), radius_mm=-1)
except er.InputError as error:
    print(error)

# %%
figure, axes = plt.subplots(figsize=(5, 5))
axes.plot(*before.pupil.points_px[0].T, color="black", lw=1, label="pupil boundary")
axes.plot(*before.glints.xy_px[0].T, "o", mfc="none", label="glints")
axes.plot(*after.glints.xy_px[0].T, "x", label="glints, one LED moved")
axes.set(xlabel="x (px)", ylabel="y (px)", aspect="equal")
axes.invert_yaxis()
axes.legend()
plt.show()
