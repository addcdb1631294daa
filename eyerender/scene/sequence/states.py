"""State of a sequence at some times."""

from __future__ import annotations

from dataclasses import dataclass

from ...base.arrays import ArrayValue, Bools, Floats, Statuses

BLINK_PHASES = (None, "closing", "closed", "opening")
"""Phases of a blink, as `blink_phase` of states counts them."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class States(ArrayValue):
    """Eyes, lids, head and rig at n times; the second axis of what differs between the eyes is right, left.

    Attributes:
        time_s: (n,) times.
        azimuth_rad: (n, 2) azimuth of the optic axis.
        elevation_rad: (n, 2) elevation of the optic axis.
        torsion_rad: (n, 2) torsion: that of Listing's law and the sequence's own.
        pupil_mm: (n, 2) diameter of the stop, to 0.001 mm; NaN is the scene's own.
        stop_shift_mm: (n, 2, 2) displacement of the stop along y and z of the eye's frame.
        blink: (n, 2) closure of the lids, 0 to 1; NaN is the scene's own.
        squint: (n, 2) lower lid raised; NaN is the scene's own.
        wide: (n, 2) upper lid above its rest; NaN is the scene's own.
        retraction_mm: (n, 2) how far the globe is drawn back along the orbit's axis.
        head_mm: (n, 3) displacement of the head.
        rig_rotation_rad: (n, 3) rotation vector of the rig's motion x' = R x + t.
        rig_translation_mm: (n, 3) its translation.
        target_mm: (n, 3) what is looked at; NaN where nothing is.
        events: (n, 6) which of `observation.EVENTS` hold.
        blink_phase: (n,) index into `BLINK_PHASES`.
    """

    time_s: Floats
    azimuth_rad: Floats
    elevation_rad: Floats
    torsion_rad: Floats
    pupil_mm: Floats
    stop_shift_mm: Floats
    blink: Floats
    squint: Floats
    wide: Floats
    retraction_mm: Floats
    head_mm: Floats
    rig_rotation_rad: Floats
    rig_translation_mm: Floats
    target_mm: Floats
    events: Bools
    blink_phase: Statuses
