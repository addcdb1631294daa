"""
Your own rig
============

A rig is made of cameras, LEDs and a screen. Here a camera with a ring of eight LEDs looks at an eye from 5 cm, and one
LED is moved.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

SAMPLES = 16  # small: 2

camera = er.Camera.looking_at((0, 0, 0), position_mm=(45, -10, -25), focal_length_px=1500, size_px=(480, 400))
ring = er.Led(ring=er.rig.LedRing(radius_mm=14, count=8), intensity_mw_sr=2)
rig = er.Rig(cameras=[camera], lights=[ring])
changed = rig.with_light(2, moved_mm=(0, 4, 0))

# %%
# Every LED of the ring has a glint. Moving one LED by 4 mm moves its glint and no other.
frames = er.Subject.one_eye(er.Eye("E4")).looking([(0, 0)], rig)
before = er.trace(frames).glints.xy_px[0]
after = er.trace(frames, changed).glints.xy_px[0]
print("the glints moved by (px):", np.linalg.norm(after - before, axis=-1).round(2))

# %%
# A mistake gives one line that says what is wrong.
try:
    er.Led((600, 0, 0), radius_mm=-1)
except er.InputError as error:
    print(error)

# %%
# On the left are the LEDs, seen from behind the camera; on the right is the picture of the changed rig. The cornea is a
# convex mirror, so each glint lies on the side of its LED.
image = er.render(frames[0], changed, spp=SAMPLES, sensor=er.Sensor(exposure_ms=3))
colours = ["tab:red" if number == 2 else "tab:cyan" for number in range(8)]
figure, (front, eye) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
places = np.array([light.position_mm for light in changed.build().lights])
old = rig.build().lights[2].position_mm
front.scatter(places[:, 1], places[:, 2], s=160, c=colours)
front.scatter(old[1], old[2], s=160, facecolors="none", edgecolors="tab:red", linestyle="--")
front.plot(*camera.position_mm[1:], "ks", ms=16)
front.annotate("camera", camera.position_mm[1:], (0, 14), textcoords="offset points", ha="center")
eye.imshow(image.counts, cmap="gray")
for number, (place, glint) in enumerate(zip(places, after, strict=True)):
    front.annotate(str(number), place[1:], ha="center", va="center", fontsize=8)
    eye.annotate(str(number), glint, (0, 11), textcoords="offset points", ha="center", color="gold")
eye.plot(*before[2], "o", ms=9, mfc="none", color="tomato")
eye.annotate("before the move", before[2], (10, -14), textcoords="offset points", color="tomato")
front.set(title="ring of LEDs, one of them moved", xlabel="y (mm)", ylabel="z, up (mm)", aspect="equal")
front.margins(0.15)
eye.set(title="their glints in the picture", xlim=(130, 350), ylim=(345, 130))
eye.axis("off")
plt.show()
