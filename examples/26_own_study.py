"""
A study of your own
===================

Conditions, eye models or drawn people, estimators and findings in one class, which is also a command:
``eyerender study my_module:HeadMoves -o out``. See :doc:`/studies`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import eyerender as er

PEOPLE = 8  # small: 2


# %%
# Each estimator is calibrated in the first condition and tested in all. A condition changes groups of the scene.
class HeadMoves(er.apps.Study):
    title = "A head that moves after the calibration"
    about = ("Two estimators before the remote tracker with two lights; the head moves towards the screen.",)
    scene_name = "guestrin2006"
    conditions = {f"{mm} mm": {"subject": {"head_positions_mm": [[mm, 0, 0]]}} for mm in (0, 20, 40)}
    estimators = {"model": er.gaze.GuestrinEizenman(), "polynomial": er.gaze.Regression("R3", normalised=False)}
    eyes = ("E1", "E4")

    def findings(self, parts):
        """Test that the model-based estimator stands the movement better."""
        found = []
        for part in parts:
            mean = {row.variant: row.mean_deg for row in part.rows}
            rise = {name: mean[f"{name}, 40 mm"] - mean[f"{name}, 0 mm"] for name in self.estimators}
            rule = f"{part.eye_model}: the model's error rises less than the polynomial's by 40 mm: difference (deg)"
            value = rise["model"] - rise["polynomial"]
            found.append(er.apps.Finding.of("S1", ("own", "analytic"), rule, value, "< 0"))
        return found


# %%
# A run writes a report, the means and the findings. Here people stand in place of the eye models.
with tempfile.TemporaryDirectory() as folder:
    summary = er.apps.run_study(HeadMoves, Path(folder) / "out", people=PEOPLE)

# %%
figure, axis = plt.subplots(figsize=(6.5, 4), layout="constrained")
for name, colour in (("model", "#0072B2"), ("polynomial", "#D55E00")):
    for who in {row["eye_model"] for row in summary["rows"]}:
        rows = [r for r in summary["rows"] if r["eye_model"] == who and r["variant"].startswith(name)]
        label = name if who.endswith("/0") else None
        axis.plot([0, 20, 40], [row["mean_deg"] for row in rows], marker="o", color=colour, label=label)
axis.set(xlabel="head towards the screen (mm)", ylabel="mean error (deg)", ylim=(0, None))
axis.legend()
plt.show()
