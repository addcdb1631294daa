"""Frames of sequences as exports need them: to which recording they belong, their times, and the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ...base.errors import InputError
from ...base.storage.files import parse_json
from ...scene.observation import EYES
from .gaze import gaze_of
from .item import Item

USUAL_HZ = 60.0  # rate of a camera that states none


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """A frame of one eye in a sequence."""

    subject: int  # number of the person
    split: str  # name of the split
    camera: int  # number of the camera
    eye: str  # `right` or `left`
    # name of the camera's recording of this eye: `eye0` (right) or `eye1`, with the number of the camera where several
    # see the eye
    name: str
    rate_hz: float  # frames per second of the camera
    time_s: float  # time of the frame's middle
    timestamp_s: float | None  # the time that the camera stored; None if it stores none
    truth: list[Any]  # values of the columns `TRUTH` of a trace
    sight_mm: list[float]  # a point on the line of sight, in the world
    sight: list[float]  # unit vector of the line of sight
    shown: bool  # whether the eye shows its gaze (`gaze_valid` of other exports)
    screen: Mapping[str, Any] | None  # the scene's screen, as authored; None if it has none


def moment_of(item: Item) -> Moment:
    """Return the frame of an image; InputError if the image is no frame of a sequence of one eye."""
    line, records = item.line, item.line["records"]
    if len(records) != 1 or records[0]["events"] is None:
        raise InputError("shows no frame of a sequence of one eye", source=item.entry.name)
    record, labels = records[0], line["labels"]
    rig = parse_json(line["parameters"]["scene_json"], path="scene_json")["rig"]
    cameras, number, eye = rig["cameras"], int(record["camera"]), record["eye"]
    several = sum(eye in (camera.get("eyes") or EYES) for camera in cameras) > 1
    pose, lids, space = record["pose"], labels["lid_opening"] or {}, labels["space"]["world"]
    return Moment(
        subject=line["subject"],
        split=item.split,
        camera=number,
        eye=eye,
        name=f"eye{EYES.index(eye)}" + (f"_camera{number}" if several else ""),
        rate_hz=float(cameras[number].get("frame_rate_hz") or USUAL_HZ),
        time_s=float(record["time_s"]),
        timestamp_s=line["timestamp_s"],
        truth=[
            pose["azimuth_deg"],
            pose["elevation_deg"],
            labels["pupil"]["stop_diameter_mm"],
            lids.get("mm"),
            "+".join(record["events"]),
            record["blink_phase"],
        ],
        sight_mm=space["line_of_sight_point_mm"],
        sight=space["line_of_sight"],
        shown=bool(gaze_of(line)["gaze_valid"]),
        screen=rig.get("screen"),
    )


@dataclass(slots=True)
class Recordings:
    """Counter of the recordings of each person: in a new one, time begins anew."""

    last: dict[tuple[int, int, str], tuple[int, float]] = field(default_factory=dict)

    def number(self, moment: Moment) -> int:
        """Return the number, from 1, of the recording of the next frame of a camera and eye."""
        key = moment.subject, moment.camera, moment.eye
        number, time_s = self.last.get(key, (0, moment.time_s))
        number += moment.time_s <= time_s
        self.last[key] = number, moment.time_s
        return number
