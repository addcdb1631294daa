"""OpenCV filters for measurements outside the extractor."""

from __future__ import annotations

import cv2
import numpy as np

from ..base.arrays import Bytes, Singles


def median_filtered(image: Bytes, size: int) -> Bytes:
    """Replace each pixel of an 8-bit image by the median of the square of `size` (odd) pixels around it."""
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(image), size), dtype=np.uint8)


def resized(image: Singles, width: int, height: int) -> Singles:
    """Resize an image: area averages when shrinking, bicubic when enlarging."""
    method = cv2.INTER_AREA if width * height < image.size else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(np.ascontiguousarray(image), (width, height), interpolation=method), dtype=np.float32)
