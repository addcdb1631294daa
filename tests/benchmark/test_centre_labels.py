"""Layouts that label only the pupil's centre (LPW, ExCuSe), and frames of a video in a table of one's own."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from eyerender.apps.benchmark.folder import load_labelled
from eyerender.apps.benchmark.protocol import Reply
from eyerender.apps.benchmark.score import score
from eyerender.apps.benchmark.summary import curves_of, summarise
from eyerender.base.errors import InputError
from eyerender.folders.imagefile import read_any_image, write_png
from eyerender.optics.ellipse import Ellipse

SIZE = (120, 80)  # width, height


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def picture(x, y):
    """A dark disc at a place."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.where(np.hypot(u - x, v - y) < 12, 20, 150).astype(np.uint8)


def darkest(path):
    """Centre of the dark disc of a picture."""
    y, x = np.nonzero(read_any_image(path)[0] < 85)
    return x.mean(), y.mean()


def record(path, centres):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, SIZE)
    for centre in centres:
        writer.write(cv2.cvtColor(picture(*centre), cv2.COLOR_GRAY2BGR))
    writer.release()


def lpw(folder, centres, labels=None):
    (folder / "7").mkdir(parents=True)
    record(folder / "7" / "3.avi", centres)
    lines = [f"{x:.6f} {y:.6f}" for x, y in labels or centres]
    (folder / "7" / "3.txt").write_text("\n".join(lines) + "\n")
    return folder


def excuse(folder, x, y):
    """A labelled image; the table has twice the size, and y upward."""
    (folder / "data set I").mkdir(parents=True)
    write_png(folder / "data set I" / "0000000836.png", picture(x, y))
    table = f"index image x y\n1 836 {2 * x:g} {2 * (SIZE[1] - y):g}\n"
    (folder / "data set I.txt").write_text(table)
    return folder


def test_lpw_labels_a_frame_per_line(tmp_path):
    images = load_labelled(lpw(tmp_path, [(40.0, 30.0), (62.0, 41.0)]))
    assert [(i.name, i.subject) for i in images] == [("7/3.avi/000001", "7"), ("7/3.avi/000002", "7")]
    for image in images:
        assert image.pupil is None
        assert image.shows_pupil
        assert image.centre_px == pytest.approx(darkest(image.path), abs=0.2)
        assert "no pupil" not in image.conditions


def test_a_subject_of_lpw_is_read_alone_and_frames_without_a_label_are_left_out(tmp_path):
    folder = lpw(tmp_path, [(40.0, 30.0), (62.0, 41.0)], [(40.0, 30.0), (-1.0, -1.0)])
    (image,) = load_labelled(folder / "7")
    assert image.name == "3.avi/000001"


@pytest.mark.parametrize(
    ("labels", "match"),
    [([(1.0, 2.0)] * 3, "labels 3 frames; the video has 1"), ([(float("nan"), 2.0)], "line 1: needs 2 numbers")],
)
def test_tables_of_lpw_that_do_not_fit_are_refused(tmp_path, labels, match):
    with pytest.raises(InputError, match=match):
        load_labelled(lpw(tmp_path, [(40.0, 30.0)], labels))


def test_excuse_has_twice_the_size_and_counts_from_the_lower_edge(tmp_path):
    (image,) = load_labelled(excuse(tmp_path, 47.0, 22.0))
    assert (image.name, image.subject) == ("data set I/0000000836.png", "data set I")
    assert image.centre_px == pytest.approx(darkest(image.path), abs=0.1)


@pytest.mark.parametrize(
    ("line", "match"), [("1 837 90 80", "there is no image 837"), ("1 836 90", "line 2: needs 4 numbers")]
)
def test_tables_of_excuse_that_do_not_fit_are_refused(tmp_path, line, match):
    excuse(tmp_path, 47.0, 22.0)
    (tmp_path / "data set I.txt").write_text(f"index image x y\n{line}\n")
    with pytest.raises(InputError, match=match):
        load_labelled(tmp_path)


def answer(x, y):
    ellipse = None if x is None else Ellipse(np.array([x, y]), np.array([12.0, 11.0]), 0.0)
    return Reply(ellipse=ellipse, reason=None, confidence=None, glints=(), cpu_s=None, wall_s=None)


def test_a_centre_within_five_pixels_is_right_and_nothing_else_is_known(tmp_path):
    (image,) = load_labelled(excuse(tmp_path, 47.0, 22.0))
    scores = [score(image, reply, 0.0, ("pupil",)) for reply in (answer(50, 26), answer(50, 26.1), answer(None, None))]
    assert [s.outcome for s in scores] == ["right", "wrong", "none"]
    assert scores[0].centre_px == pytest.approx(5.0)
    summary = summarise(scores)
    assert summary["rates"]["right"] == pytest.approx(1 / 3)
    assert (summary["iou"]["median"], summary["semi_axes_bias_px"]) == (None, None)
    curves = curves_of(scores)
    assert set(curves["iou"]["share"]) == {None}
    assert curves["centre_px"]["share"][-1] == pytest.approx(2 / 3)


def test_a_table_names_frames_of_a_video(tmp_path):
    record(tmp_path / "clip.avi", [(40.0, 30.0), (62.0, 41.0)])
    heading = "image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg\n"
    (tmp_path / "labels.csv").write_text(heading + "clip.avi/2,62,41,12,12,0\nclip.avi/1,40,30,12,12,0\n")
    for image in load_labelled(tmp_path):
        assert image.pupil.centre_px == pytest.approx(darkest(image.path), abs=0.2)
    (tmp_path / "labels.csv").write_text(heading + "clip.avi/3,62,41,12,12,0\n")
    with pytest.raises(InputError, match="has frames 1 to 2"):
        load_labelled(tmp_path)
