"""Videos, both eyes of a frame, colour, and pictures of what was found."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.extraction import REFINED, extract, extract_eyes
from eyerender.extraction.video import VideoWriter, follow
from eyerender.folders.video import SUFFIXES, VideoFrame, VideoReader
from eyerender.optics.ellipse import Ellipse, iou

SEEDS = range(20_300, 20_306)
SMALL = ideal.Condition(size=(320, 240), semi_axis=(18, 30), noise=(2, 2), aspect=(0.8, 1.0))


def _truth(drawing) -> Ellipse:
    pupil = drawing.label["pupil"]
    return Ellipse(pupil["centre_px"], pupil["semi_axes_px"], pupil["angle_rad"])


@pytest.fixture(scope="module")
def drawings():
    return [ideal.draw(SMALL, seed) for seed in SEEDS]


@pytest.fixture(scope="module")
def video(drawings, tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "eyes.mkv"
    with VideoWriter(path, 320, 240, 50.0) as writer:
        for drawing in drawings:
            writer.add(np.repeat(drawing.image[..., None], 3, axis=2))
    return path


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A video of one small grey frame."""
    path = tmp_path_factory.mktemp("still") / "eye.mkv"
    with VideoWriter(path, 64, 48, 25.0) as writer:
        writer.add(np.full((48, 64, 3), 90, np.uint8))
    return path


def test_a_followed_pupil_is_that_of_single_frames(drawings):
    # The pupil jumps by several of its sizes from frame to frame, and one frame shows none.
    images = [drawing.image for drawing in drawings]
    images.insert(3, np.full_like(images[0], 120) + np.arange(320, dtype=np.uint8) // 8)
    frames = (VideoFrame(k, k / 50.0, image, False) for k, image in enumerate(images))
    for frame, (found,) in follow(frames, settings=REFINED):
        single = extract(frame.image, settings=REFINED).pupil
        assert found.pupil.ok == single.ok
        if single.ok:
            apart = np.hypot(*(found.pupil.ellipse.centre_px - single.ellipse.centre_px))
            # Both fits end with a step below 0.001 px; the edges that they start from were chosen about other starts.
            assert apart < 0.2 * math.sqrt(np.trace(single.covariance[:2, :2]))


def test_a_wrong_prior_does_no_harm(drawings):
    elsewhere = extract(drawings[0].image).pupil
    found = extract(drawings[1].image, prior=elsewhere).pupil
    assert iou(found.ellipse, _truth(drawings[1])) > 0.95


def _film(eyes: dict[tuple[float, float], set[int]], screw: bool) -> list[np.ndarray]:
    """Forty frames (240, 320) of eyes that turn a little, by their place, with the frames in which each is shut.

    A screw is a dark disc of 20 px in the corner, fainter than a pupil.
    """
    y, x = np.mgrid[:240, :320].astype(float)
    rng, frames = np.random.default_rng(3), []
    for k in range(40):
        levels = np.full((240, 320), 150.0)
        if screw:
            levels -= 50.0 * (np.hypot(x - 34, y - 30) < 10.0)
        for (cx, cy), shut in eyes.items():
            at = np.hypot(x - cx - 6.0 * np.sin(0.3 * k), y - cy)
            if k not in shut:
                levels = np.where(at < 45.0, 80.0, levels)
                levels = np.where(at < 18.0, 25.0, levels)
                levels = np.where(np.hypot(x - cx - 7.0, y - cy + 4.0) < 2.5, 255.0, levels)
        seen = cv2.GaussianBlur(levels, (0, 0), 1.2) + rng.normal(0.0, 1.5, levels.shape)
        frames.append(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
    return frames


@pytest.mark.parametrize("shut", [{20, 21, 22, 23, 24}, {6, 7, 8}, {12, 13, 14, 15, 30, 31}])
def test_a_blink_does_not_give_the_film_to_a_screw_or_to_the_other_eye(shut, tmp_path):
    films = {
        "screw": _film({(180.0, 130.0): shut}, True),
        "wink": _film({(90.0, 120.0): shut, (240.0, 120.0): set()}, False),
    }
    for name, frames in films.items():
        film = (VideoFrame(k, k / 30.0, image, False) for k, image in enumerate(frames))
        found = [one.pupil for _, (one,) in follow(film)]
        first = found[0].ellipse.centre_px
        if name == "wink" and first[0] > 160.0:  # the eye that never shuts
            shut = set()
        for k, pupil in enumerate(found):
            assert pupil.ok == (k not in shut), (name, k)
            assert not pupil.ok or math.dist(pupil.ellipse.centre_px, first) < 25.0


def test_a_new_place_is_followed_once_it_has_lasted():
    frames = _film({(100.0, 120.0): set()}, False)[:10] + _film({(220.0, 120.0): set()}, False)[:20]
    found = [one.pupil for _, (one,) in follow(VideoFrame(k, k / 30.0, f, False) for k, f in enumerate(frames))]
    assert all(one.ok for one in found[:10])
    assert not any(one.ok for one in found[10:18])
    assert all(abs(one.ellipse.centre_px[0] - 220.0) < 10.0 for one in found[21:])


def test_frames_of_a_lossless_video(video, drawings):
    frames = list(VideoReader(video))
    assert [frame.number for frame in frames] == list(range(len(drawings)))
    assert [frame.time_s for frame in frames] == pytest.approx(np.arange(len(drawings)) / 50.0, abs=1e-3)
    for frame, drawing in zip(frames, drawings, strict=True):
        assert not frame.colour
        np.testing.assert_array_equal(frame.image, drawing.image)


def test_the_command_writes_records_and_a_picture_of_each_frame(video, drawings, tmp_path, capsys):
    records, shown = tmp_path / "records.jsonl", tmp_path / "shown.avi"
    assert run(["extract", str(video), "-o", str(records), "--overlay", str(shown)]) == 0
    assert "pupil found in 6 of 6" in capsys.readouterr().out
    lines = [json.loads(line) for line in records.read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(len(drawings)))
    for line, drawing in zip(lines, drawings, strict=True):
        assert math.dist(line["pupil"]["centre_px"], _truth(drawing).centre_px) < 0.1
        assert line["confidence"] > 0.9
    assert lines[2]["time_s"] == pytest.approx(0.04, abs=1e-3)
    picture = next(iter(VideoReader(shown)))
    assert picture.colour
    assert picture.image.shape == (240, 320)


def test_both_eyes_by_the_image_side(drawings):
    first, second = drawings[0], drawings[1]
    both = np.hstack([first.image, second.image])
    left, right = extract_eyes(both)
    assert iou(left.pupil.ellipse, _truth(first)) > 0.95
    assert iou(right.pupil.ellipse, _truth(second).shifted((320.0, 0.0))) > 0.95
    blank = np.full_like(first.image, 100)
    left, right = extract_eyes(np.hstack([blank, first.image]))
    assert not left.pupil.ok
    assert iou(right.pupil.ellipse, _truth(first).shifted((320.0, 0.0))) > 0.95


@pytest.mark.parametrize(("arrangement", "join"), [("side-by-side", np.hstack), ("stacked", np.vstack)])
@pytest.mark.parametrize("order", [None, "right-left", "left-right"])
def test_joined_pictures_of_two_cameras(drawings, tmp_path, capsys, arrangement, join, order):
    """Images and videos: the left or upper picture is the right eye, unless the order is reversed."""
    pairs = [(drawings[k], drawings[k + 1]) for k in range(2)]
    frames = [join([first.image, second.image]) for first, second in pairs]
    for k, frame in enumerate(frames):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), frame)
    height, width = frames[0].shape
    with VideoWriter(tmp_path / "both.mkv", width, height, 50.0) as writer:
        for frame in frames:
            writer.add(np.repeat(frame[..., None], 3, axis=2))
    shift = np.array([320.0, 0.0] if arrangement == "side-by-side" else [0.0, 240.0])
    options = ["--eyes", "2", "--arrangement", arrangement, *([] if order is None else ["--order", order])]
    for files in ([tmp_path / "0.png", tmp_path / "1.png"], [tmp_path / "both.mkv"]):
        records = tmp_path / "records.jsonl"
        assert run(["extract", *map(str, files), *options, "-o", str(records)]) == 0
        lines = [json.loads(line) for line in records.read_text().splitlines()]
        assert [(line["frame"], line["eye"]) for line in lines] == [(k, e) for k in (0, 1) for e in ("right", "left")]
        for k, (first, second) in enumerate(pairs):
            places = [_truth(first).centre_px, _truth(second).centre_px + shift]
            wanted = places[::-1] if order == "left-right" else places
            for line, place in zip(lines[2 * k :], wanted, strict=False):
                assert math.dist(line["pupil"]["centre_px"], place) < 0.1
    # One eye alone: the other picture has none, and no eye is taken twice.
    blank = np.full_like(drawings[0].image, 100)
    assert cv2.imwrite(str(tmp_path / "one.png"), join([blank, drawings[0].image]))
    assert run(["extract", str(tmp_path / "one.png"), *options, "-o", str(tmp_path / "one.jsonl")]) == 0
    found = {line["eye"]: line["pupil"]["status"] for line in map(json.loads, (tmp_path / "one.jsonl").open())}
    there = "right" if order == "left-right" else "left"
    assert found.pop(there) == "ok"
    assert list(found.values()) == ["missing"]
    capsys.readouterr()


@pytest.mark.parametrize("option", [["--arrangement", "stacked"], ["--order", "left-right"]])
def test_arrangements_belong_to_two_eyes(drawings, tmp_path, capsys, option):
    assert cv2.imwrite(str(tmp_path / "0.png"), drawings[0].image)
    assert run(["extract", str(tmp_path / "0.png"), *option]) == 2
    assert f"error: {option[0]}: belongs to --eyes 2" in capsys.readouterr().err


def test_colour_is_taken_with_one_warning(drawings, tmp_path, capsys):
    drawing = drawings[0]
    colour = np.repeat(drawing.image[..., None], 3, axis=2)
    colour[..., 2] //= 2
    for k in range(2):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), colour)
    assert run(["extract", str(tmp_path / "0.png"), str(tmp_path / "1.png"), "--overlay", str(tmp_path / "seen")]) == 0
    assert capsys.readouterr().err.count("warning") == 1
    assert sorted(p.name for p in (tmp_path / "seen").iterdir()) == ["0.png", "1.png"]
    with pytest.warns(UserWarning, match="in colour"):
        found = extract(colour)
    assert iou(found.pupil.ellipse, _truth(drawing)) > 0.95


@pytest.mark.parametrize(("content", "message"), [(b"", "is empty"), (b"no video" * 99, "not a video")])
def test_a_broken_video_is_one_line(content, message, tmp_path, capsys):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        list(VideoReader(path))
    assert run(["extract", str(path), "-o", str(tmp_path / "records.jsonl")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "records.jsonl").exists()


def test_a_video_cannot_be_an_address(tmp_path):
    with pytest.raises(InputError):
        VideoReader("http://localhost:1/a.mp4")


@pytest.mark.parametrize("planted", [pytest.param("link", marks=pytest.mark.slow), "pipe"])
def test_a_name_planted_beside_the_overlay_is_not_written_to(still, planted, tmp_path):
    victim, shown = tmp_path / "victim", tmp_path / "ov.mp4"
    victim.write_text("precious")
    guessed = tmp_path / ".ov.part.mp4"
    if planted == "link":
        guessed.symlink_to(victim)
    else:
        os.mkfifo(guessed)
    # A process of its own can be ended where it would wait for the pipe.
    command = [sys.executable, "-m", "eyerender", "extract", str(still), "--overlay", str(shown)]
    assert subprocess.run(command, capture_output=True, timeout=60).returncode == 0
    assert victim.read_text() == "precious"
    assert len(list(VideoReader(shown))) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == [guessed.name, "ov.mp4", "victim"]


def test_an_unfinished_video_has_a_name_of_its_own_and_leaves_nothing(tmp_path):
    picture, place = np.zeros((48, 64, 3), np.uint8), tmp_path / "a.mp4"

    def fail() -> None:
        with VideoWriter(place, 64, 48, 25.0) as first:
            with VideoWriter(place, 64, 48, 25.0) as second:
                assert len(list(tmp_path.iterdir())) == 2
                first.add(picture)
                second.add(picture)
            assert len(list(VideoReader(place))) == 1
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize("option", ["--overlay", "-o", "--json"])
@pytest.mark.parametrize("target", ["pipe", "folder", "link to a pipe"])
def test_what_is_no_file_is_not_written_to(still, option, target, tmp_path, capsys):
    place = tmp_path / "out.mp4"
    if target == "pipe":
        os.mkfifo(place)
    elif target == "folder":
        place.mkdir()
    else:
        os.mkfifo(tmp_path / "pipe")
        place.symlink_to("pipe")
    before = place.lstat()
    assert run(["extract", str(still), option, str(place)]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"error: {place}: is a ")
    assert os.path.samestat(before, place.lstat())


def _script(folder, kind):
    """Write a file that is called a video and names other files."""
    texts = {
        "concat": "ffconcat version 1.0\nfile real.mkv\n",
        "playlist": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nreal.mkv\n#EXT-X-ENDLIST\n",
        "session": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
        "dash": '<?xml version="1.0"?><MPD><Period><BaseURL>real.mkv</BaseURL></Period></MPD>',
        "image2": "real%03d.mkv",
    }
    path = folder / "eyes.mp4"
    path.write_text(texts[kind])
    return path


@pytest.mark.parametrize("kind", ["concat", "playlist", "session", "dash", "image2"])
def test_a_video_that_is_a_script_is_refused_in_one_line(video, kind, tmp_path, capsys):
    (tmp_path / "real.mkv").write_bytes(video.read_bytes())
    path = _script(tmp_path, kind)
    assert run(["extract", str(path), "-o", str(tmp_path / "records.jsonl")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said == [f"error: {path}: is not a video ({', '.join(SUFFIXES)})"]
    assert not (tmp_path / "records.jsonl").exists()


def test_a_script_that_begins_like_a_video_is_not_taken_for_one(video, tmp_path):
    """Each of FFmpeg's readers is named, so what follows the first bytes cannot choose another one."""
    (tmp_path / "real.mkv").write_bytes(video.read_bytes())
    for head in (b"\0\0\0\x14ftyp", b"\0\0\0\x08free", b"RIFF\0\0\0\0AVI ", b"\x1aE\xdf\xa3", b"\0\0\1\xba"):
        path = tmp_path / "eyes.mp4"
        path.write_bytes(head + b"\nffconcat version 1.0\nfile real.mkv\n" * 20)
        with pytest.raises(InputError, match=r"not a video|no frame"):
            list(VideoReader(path))


@pytest.mark.parametrize("name", ["a%03d.mkv", "a*.mkv", "[1-3].mkv", "concat:a.mkv", "a,b|c.mkv"])
def test_a_name_is_no_pattern(video, name, tmp_path):
    path = tmp_path / name
    path.write_bytes(video.read_bytes())
    assert len(list(VideoReader(path))) == len(SEEDS)


@pytest.mark.parametrize(
    ("ending", "code"),
    [(".mp4", "mp4v"), (".m4v", "mp4v"), (".mov", "mp4v"), (".avi", "MJPG"), (".mkv", "FFV1"), (".webm", "VP80"),
     (".mpg", "MPG1"), (".mpeg", "MPG2"), (".wmv", "WMV2"), (".ts", "MPG2"), (".m2v", "MPG2")],
)  # fmt: skip
def test_each_kind_of_video_is_read(ending, code, tmp_path, monkeypatch):
    path = tmp_path / f"a{ending}"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), 25.0, (64, 48))
    assert writer.isOpened()
    for k in range(5):
        writer.write(np.full((48, 64, 3), 40 * k, np.uint8))
    writer.release()
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "threads;1")
    assert [int(frame.image.mean()) // 40 for frame in VideoReader(path.rename(path.with_suffix(".mp4")))][:1] == [0]
    assert os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] == "threads;1"
