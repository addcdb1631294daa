"""
Lids, lashes and ambient light
==============================

The eye region adds lids, lashes, brow and skin. A blink hides the pupil step by step, and the labels say how much of it
is left.
"""

import matplotlib.pyplot as plt

import eyerender as er

SAMPLES = 16  # small: 1
BLINKS = (0.0, 0.35, 0.6, 1.0)  # small: (0.5,)

camera = er.Camera.looking_at((0, 0, -2), position_mm=(250, -40, -60), focal_length_px=2400, size_px=(400, 300))
rig = er.Rig(cameras=[camera], lights=[er.Led((250, 40, -60), intensity_mw_sr=40), er.Led((250, -120, -60))])
subject = er.Subject.one_eye(er.Eye("E4", pupil_diameter_mm=4.0))
frames = subject.looking([(0, 0)], rig)

# %%
figure, axes = plt.subplots(1, len(BLINKS), figsize=(3 * len(BLINKS), 2.6), squeeze=False)
for ax, blink in zip(axes.flat, BLINKS, strict=True):
    image = er.render(frames[0], spp=SAMPLES, region=er.Region(blink=blink))
    ax.imshow(image.counts, cmap="gray")
    ax.set_title(f"pupil visible {image.labels['pupil']['visible_fraction'] or 0:.0%}", fontsize=9)
    ax.axis("off")
plt.show()
