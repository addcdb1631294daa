"""
What each cause costs in gaze
=============================

The error of gaze has many causes: the estimator's own geometry, the eye, the image, its noise. The budget moves from
exact features of a simple eye to features from noisy images, one cause at a time, and compares the estimates frame by
frame.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

GRID, SPP, SEEDS = (3, 2), 8, 10  # small: (3, 2), 4, 2

camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -200), focal_length_px=4500, size_px=(1280, 720))
rig = er.Rig(
    cameras=[camera],
    lights=[er.Led((600, 150, -200), intensity_mw_sr=60), er.Led((600, -150, -200), intensity_mw_sr=60)],
    screen=er.Screen((600, 0, 0), (400, 240)),
)
subject = er.Subject(er.Eye("E4", pupil_diameter_mm=4.0), eyes=["right"])
scene = er.Scene(subject, rig, targets=er.Targets(grid=GRID), lens=er.rig.Lens(glare=0.1), image=er.Picture(spp=SPP))
steps = er.budget_steps(scene.frames(), seeds=SEEDS)
print(list(steps))

# %%
# A regression of first order needs few targets, but is coarse. The model-based estimator knows the optics, but the
# sphere that it assumes is not this cornea. ``print(found)`` shows the tables.
estimators = {"regression R2": er.gaze.Regression("R2", normalised=False), "model-based": er.gaze.GuestrinEizenman()}
budgets = {name: er.gaze.budget(steps, rig, estimator) for name, estimator in estimators.items()}
for name, found in budgets.items():
    print(f"\n{name}\n{found}")

# %%
# The bars are the rms angles between the paired estimates. A pale bar shows the net effect on the mean error. It can be
# small, or negative, although gaze moves.
figure, axes = plt.subplots(1, 2, figsize=(9, 4), sharey=True)
for ax, (name, found) in zip(axes, budgets.items(), strict=True):
    at = np.arange(len(found.causes))
    ax.barh(at, [cause.rms_deg for cause in found.causes], 0.4, label="rms angle")
    ax.barh(at + 0.4, [cause.net_deg for cause in found.causes], 0.4, alpha=0.4, label="net effect")
    ax.set(title=f"{name}: {found.mean_deg:.2f}° mean error", xlabel="degrees", yticks=at + 0.2)
    ax.set_yticklabels([cause.name for cause in found.causes])
axes[0].invert_yaxis()
axes[0].legend()
figure.tight_layout()
plt.show()
