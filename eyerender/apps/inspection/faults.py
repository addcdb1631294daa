"""Kinds of faults: what is wrong with an image, or so odd that somebody should look at it."""

from __future__ import annotations

from dataclasses import dataclass

KINDS = {
    "line": "the line of metadata cannot be read, or lacks labels",
    "label": "a label is missing where its status says that it exists, or is out of its range",
    "file": "the picture is missing or cannot be read, or another file that its line names is missing",
    "size": "the picture or a mask has another size than the window",
    "black": "the picture is black",
    "white": "the picture is white",
    "contrast": "the pupil has no contrast to the iris",
    "flat": "the picture shows nothing: all of it has one level",
    "mask": "the mask is missing, cannot be read, or holds an unknown class",
    "mask and labels": "the mask shows other pixels of pupil or iris than the labels describe",
    "pupil": "two labels of the pupil contradict each other",
    "glint": "two labels of a glint contradict each other",
    "pupil outside": "the centre of the pupil lies outside of the picture",
    "same frame": "two lines have the same frame, camera and eye, or name the same file",
    "same picture": "two pictures have the same pixels",
    "near-duplicate": "two pictures differ by little more than noise or brightness",
    "subject in two splits": "the subject has images in more than one split",
}
"""Kind -> what it means, in the order of pages."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of an image: one of `KINDS`, and what was found."""

    kind: str
    detail: str
