"""Extract a video's features, frame by frame, to records in a file."""

from __future__ import annotations

import json
import math
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import Warn
from ..base.progress import Progress, notify
from ..base.storage.files import written
from ..extraction.overlay import overlay as drawn
from ..extraction.video import VideoWriter, follow
from ..folders.video import VideoReader
from ..gaze.records import is_table
from ..gaze.table import features_csv
from ..scene import Scene
from .imageobserver import Gathering, ImageObserver, colour_warning, lights_of


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoSummary:
    """Counts of a video's frames, of searched pupils and of detected pupils."""

    source: str
    frames: int
    pupils: int
    found: int
    records: str | None

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON."""
        return {
            "schema": "eyerender/video/1", "video": self.source, "frames": self.frames, "pupils": self.pupils,
            "found": self.found, "records": self.records,
        }  # fmt: skip

    def to_text(self) -> str:
        """Format the counts as one line."""
        where = f"; records in {self.records}" if self.records else ""
        return f"{self.source}: {self.frames} frames, pupil found in {self.found} of {self.pupils}{where}"


@dataclass(frozen=True, slots=True)
class VideoOutput:
    """Files written for an observed video."""

    records: Path | None = None  # one record per line (JSON), or a table (.csv) of `features_csv`
    overlay: Path | None = None  # video with the results drawn over the frames (.mp4, .avi or .mkv)


def observe_video(
    video: VideoReader,  # the video, of which nothing has been read
    observer: ImageObserver,  # the image observer, with its settings and gamma
    output: VideoOutput = VideoOutput(),  # files to write
    *,
    scene: Scene | None = None,  # the scene whose rig took the video
    eyes: int = 1,  # 1, or 2 for frames with both eyes, as in `ImageObserver.observe_files`
    progress: Progress | None = None,  # called after each frame
    # receives a warning if frames have colour or are missing; if it raises, nothing is written
    warn: Warn | None = None,
) -> VideoSummary:
    """Extract the features of a video's frames."""
    count = pupils = ok = coloured = 0
    with ExitStack() as stack:
        file = None if output.records is None else stack.enter_context(written(output.records, sync=False))
        table = output.records is not None and is_table(output.records)
        gathered = Gathering()
        writer: VideoWriter | None = None
        for frame, found in follow(
            video, gamma=observer.gamma, settings=observer.settings, eyes=eyes, rois=observer.rois
        ):
            if output.overlay is not None:
                if writer is None:
                    height, width = frame.image.shape
                    writer = stack.enter_context(VideoWriter(output.overlay, width, height, video.frames_per_s))
                writer.add(drawn(frame.image, found, 255.0))
            time_s = frame.time_s if math.isfinite(frame.time_s) else math.nan
            seen = observer.observe_found(
                found, frame.number, frame.image.shape, scene=scene, source=video.source, time_s=time_s
            )
            if table:
                gathered.add(seen)
            elif file is not None:
                file.writelines(json.dumps(one, allow_nan=False).encode() + b"\n" for one in seen.records())
            count, pupils, coloured = count + 1, pupils + len(found), coloured + frame.colour
            ok += sum(one.pupil.ok for one in found)
            notify(progress, count, max(video.count, count), "frames")
        if file is not None and table:
            file.write(features_csv(gathered.all(), lights_of(scene)).encode())
        if warn is not None:  # before the files are published
            warn(
                [
                    *observer.camera_warnings(scene),
                    *video.warnings(),
                    *([colour_warning(coloured, "frames")] if coloured else []),
                ]
            )
    return VideoSummary(
        source=video.source,
        frames=count,
        pupils=pupils,
        found=ok,
        records=None if output.records is None else str(output.records),
    )
