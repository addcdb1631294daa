"""
Your own gaze estimator
=======================

An estimator is a class with ``fit`` and ``predict``. It works wherever a built-in one does, also on the command line:
``eyerender compare FOLDER --estimator mymodule:PupilOnly``.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er


class PupilOnly:
    """A plane fitted to the pupil's place in the image, without any glint."""

    def __init__(self, weights=None):
        self.weights = weights

    @staticmethod
    def _terms(observations):
        return np.column_stack([np.ones(len(observations)), observations.pupil.centre_px])

    def fit(self, observations, rig):
        weights = {}
        for eye in (0, 1):
            rows = (observations.index.eye == eye) & observations.pupil.ok
            if rows.any():
                terms = self._terms(observations)[rows]
                weights[eye] = np.linalg.lstsq(terms, observations.index.target_mm[rows], rcond=None)[0]
        return PupilOnly(weights)

    def predict(self, observations, rig):
        terms = self._terms(observations)
        points = [terms[i] @ self.weights[eye] for i, eye in enumerate(observations.index.eye)]
        return er.gaze.GazePoints.of(points)


scene = er.load_scene("blignaut2014")
truth = er.trace(scene)
estimators = {"PupilOnly": PupilOnly(), "Regression R3, with the glint": er.gaze.Regression("R3")}

# %%
# Each target is left out once and estimated by a calibration on the others. The lines lead from the targets (dots) to
# the estimates, enlarged so that they can be seen.
ENLARGED = 5
figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), sharex=True, sharey=True, layout="constrained")
for ax, (name, estimator) in zip(axes, estimators.items(), strict=True):
    errors = er.gaze.leave_one_target_out(estimator, truth, scene.rig)
    print(f"{name}: mean {errors.mean_deg:.3f}, largest {errors.max_deg:.3f} degrees")
    right, up = -errors.target_mm[:, 1], errors.target_mm[:, 2]
    miss = ENLARGED * (errors.point_mm - errors.target_mm)
    ax.plot([right, right - miss[:, 1]], [up, up + miss[:, 2]], color="grey", lw=1, zorder=0)
    dots = ax.scatter(right, up, c=errors.error_deg, s=28, cmap="plasma_r", vmin=0, vmax=0.9)
    ax.set(title=f"{name}: {errors.mean_deg:.2f}°", xlabel="to the right on the screen (mm)", aspect="equal")
axes[0].set_ylabel("up (mm)")
figure.colorbar(dots, ax=axes, label="error (degrees)", shrink=0.75)
plt.show()
