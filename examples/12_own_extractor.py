"""
Your own feature extractor
==========================

An extractor is a function that takes an image and returns a record. The bench runs each extractor in a separate
process and compares its results with the exact labels.
"""

import importlib
import os
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import eyerender as er

SAMPLES = 4  # small: 1

out = Path(tempfile.mkdtemp())
er.render_folder(er.load_scene("quickstart").with_(spp=SAMPLES), out / "images")

# %%
# The module below takes the darkest pixels for the pupil. It is a file, because another process imports it.
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
result = er.apps.bench_extractors(out / "images", out / "bench", ["own-fast", "darkest:find"])
medians = {e["name"]: e["summary"]["centre_px_of_all_found"]["median"] for e in result["extractors"]}
print(medians, "report:", out / "bench" / "report.html")

# %%
# On the left one image with the true pupil and the one that ``darkest:find`` reports: lashes and shadows are dark, too.
# On the right the median distance of the pupil's centre from the exact label, over all images.
sys.path.insert(0, str(out))
entry = er.ImageFolder.load(out / "images").entries[0]
image = entry.image()
found = importlib.import_module("darkest").find(image, {})["pupil"]
figure, (picture, bars) = plt.subplots(1, 2, figsize=(9, 3.4), width_ratios=(1.2, 1), layout="constrained")
picture.imshow(image, cmap="gray")
picture.plot(*(entry.truth().pupil.points_px[0] - entry.window[:2]).T, color="tab:cyan", label="exact label")
picture.plot(*found["centre_px"], "+", color="tab:orange", ms=12)
picture.add_patch(
    plt.Circle(found["centre_px"], found["semi_axes_px"][0], fill=False, color="tab:orange", label="darkest:find")
)
picture.legend(loc="lower right")
picture.axis("off")
drawn = bars.barh(list(medians), list(medians.values()), color=["tab:blue", "tab:orange"])
bars.bar_label(drawn, fmt=" %.2g px")
bars.set(title="median error of the pupil's centre", xlabel="px", xscale="log")
bars.margins(x=0.3)
plt.show()
