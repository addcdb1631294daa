"""State of a sequence at some times."""

from __future__ import annotations

from dataclasses import dataclass

from ...base.arrays import ArrayValue, Bools, Floats, Statuses

BLINK_PHASES = (None, "closing", "closed", "opening")
"""Phases of a blink, as `blink_phase` of states counts them."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class States(ArrayValue):
    """Eyes, lids, head and rig at n times; the second axis of what differs between the eyes is right, left."""

    time_s: Floats  # (n,) times
    azimuth_rad: Floats  # (n, 2) azimuth of the optic axis
    elevation_rad: Floats  # (n, 2) elevation of the optic axis
    torsion_rad: Floats  # (n, 2) torsion: that of Listing's law and the sequence's own
    pupil_mm: Floats  # (n, 2) diameter of the stop, to 0.001 mm; NaN is the scene's own
    stop_shift_mm: Floats  # (n, 2, 2) displacement of the stop along y and z of the eye's frame
    blink: Floats  # (n, 2) closure of the lids, 0 to 1; NaN is the scene's own
    squint: Floats  # (n, 2) lower lid raised; NaN is the scene's own
    wide: Floats  # (n, 2) upper lid above its rest; NaN is the scene's own
    retraction_mm: Floats  # (n, 2) how far the globe is drawn back along the orbit's axis
    head_mm: Floats  # (n, 3) displacement of the head
    rig_rotation_rad: Floats  # (n, 3) rotation vector of the rig's motion x' = R x + t
    rig_translation_mm: Floats  # (n, 3) its translation
    target_mm: Floats  # (n, 3) what is looked at; NaN where nothing is
    events: Bools  # (n, 6) which of `observation.EVENTS` hold
    blink_phase: Statuses  # (n,) index into `BLINK_PHASES`
