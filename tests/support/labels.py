"""The labels that a rendered folder would hold of one image."""

from dataclasses import replace

from eyerender.analytic.observer import trace
from eyerender.imaging.labels import image_labels


def labels_of(image):
    """The labels of an image without its folder."""
    return image_labels(replace(image, row=0), trace(image.frame))
