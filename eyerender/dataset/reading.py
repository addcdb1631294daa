"""Instructions for reading images of 16 bits: the text and the code that data cards show."""

from __future__ import annotations

WHOLE = """\
Pillow's `convert("L")` and `convert("RGB")` clip at 255, so they turn nearly every pixel of a 16-bit image white.
OpenCV without `IMREAD_UNCHANGED` drops the low 8 bits, which leaves 2 to 3 values in a pupil. Read the counts:

```python
import cv2
import numpy as np
from PIL import Image

counts = np.asarray(Image.open(path))  # (h, w) uint16
counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)  # the same
```
"""

IMAGEFOLDER = """\
Rows of `datasets` hold Pillow images, so `np.asarray(row["image"])` gives the counts; do not cast the column to a mode.
For 8-bit copies, use `eyerender export-dataset`, or apply one gain for the whole dataset and a curve:

```python
picture = np.round(255 * np.minimum(1, gain * (counts / 65535)) ** (1 / 2.2)).astype(np.uint8)
```
"""

WEBDATASET = """\
The decoders of webdataset itself ("pil", "rgb8", "l" and so on) also convert to 8 bits and turn these images white. Use
your own:

```python
import io

import webdataset as wds


def counts_of(data):
    return np.asarray(Image.open(io.BytesIO(data)))


samples = wds.WebDataset(tar, shardshuffle=False).decode(wds.handle_extension("png", counts_of))
```
"""
