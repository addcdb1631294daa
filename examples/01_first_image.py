"""
First image
===========

An eye, a camera and a lamp give a near-infrared image with exact labels.
"""

import matplotlib.pyplot as plt

import eyerender as er

SAMPLES = 64  # small: 2

eye = er.Eye.load("E4", pupil_diameter_mm=4.0)
camera = er.Camera.looking_at((0, 0, 0), position_mm=(300, 0, -80), focal_length_px=4000, size_px=(320, 240))
rig = er.Rig(cameras=[camera], lights=[er.Led((300, 60, -80)), er.Led((300, -60, -80))])

# %%
# A subject looks somewhere: here one eye looks five degrees to the side and up. The frames hold the pose of each eye.
frames = er.Subject.one_eye(eye).looking([(5, 5)], rig)

# %%
# Rendering a frame gives the sensor's counts, the light before noise, what each pixel shows, and the labels.
image = er.render(frames[0], spp=SAMPLES)
pupil = image.labels["pupil"]["amodal"]
print("pupil centre (px):", pupil["centre_px"], "semi-axes (px):", pupil["semi_axes_px"])
for glint in image.labels["glints"]:
    print("glint of light", glint["light"], "at", glint["xy_px"])

# %%
# Ray optics sees the same frame without an image. Its outline lies on the edge of the rendered pupil.
truth = er.trace(frames)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5))
left.imshow(image.counts, cmap="gray")
left.plot(*truth.pupil.points_px[0].T, ".", color="tab:orange", ms=2)
left.plot(*truth.glints.xy_px[0].T, "+", color="tab:blue")
left.set_title("counts, with the analytic pupil and glints")
right.imshow(image.parts, cmap="viridis")
right.set_title("parts: skin or background, sclera, iris, pupil")
plt.show()
