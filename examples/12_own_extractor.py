"""
Your own feature extractor
==========================

An extractor is a function that takes an image and returns a record. The bench runs it in a process of its own beside
others and compares the results with the exact labels.
"""

import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import eyerender as er

SAMPLES = 4  # small: 1

out = Path(tempfile.mkdtemp())
er.render_folder(er.load_scene("quickstart").with_(spp=SAMPLES), out / "images")

# %%
# The module below takes the darkest pixels for the pupil. It stands in a file, because the bench starts it anew.
(out / "darkest.py").write_text("""
import numpy as np

def find(image, request):
    dark = image < np.percentile(image, 2)
    y, x = np.nonzero(dark)
    radius = float(np.sqrt(dark.sum() / np.pi))
    centre = [float(np.median(x)), float(np.median(y))]
    return {"pupil": {"status": "ok", "centre_px": centre, "semi_axes_px": [radius, radius], "angle_rad": 0.0},
            "glints": []}

find.reports = ["pupil"]
""")
os.environ["PYTHONPATH"] = os.pathsep.join([str(out), os.environ.get("PYTHONPATH", "")])
result = er.bench_extractors(out / "images", out / "bench", ["own-fast", "darkest:find"])

# %%
# The median distance of the pupil centre from the exact label, in pixels.
medians = {e["name"]: e["summary"]["centre_px_of_all_found"]["median"] for e in result["extractors"]}
print(medians, "report:", out / "bench" / "report.html")
figure, axes = plt.subplots(figsize=(5.5, 3))
axes.bar(list(medians), list(medians.values()))
axes.set(ylabel="error of the pupil centre (px)", yscale="log")
figure.tight_layout()
plt.show()
