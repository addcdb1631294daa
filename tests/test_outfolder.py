"""Folders that commands fill: complete or not there at all, one writer at a time, and only our own files replaced."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from eyerender.apps.study import run as study
from eyerender.base.errors import EyerenderError, InputError
from eyerender.base.storage.lock import LOCK, run_lock, writer_lock
from eyerender.dataset import assemble, croissant
from eyerender.folders.imagefile import write_png
from eyerender.folders.imagefolder import DONE, KINDS, LINES, LOG, SHARDS, write_dataset
from eyerender.folders.outfolder import MARKER, clear, refuse_non_empty, staged
from eyerender.imaging.folder import render_folder
from eyerender.scene import load_scene

LINE = {"file_name": "images/a.png", "window_px": {"x0": 3, "y0": 4, "width": 5, "height": 6}, "records": []}


def fill(stage, name="a"):
    """What `render` writes, in small."""
    (stage / "images").mkdir()
    (stage / "images" / f"{name}.png").write_bytes(b"")
    write_dataset(stage, [LINE], spec={}, digest="d")


def export(stage):
    """What an export writes, in small: no known names, a folder without files."""
    (stage / "train" / "labels").mkdir(parents=True)
    (stage / "empty").mkdir()
    (stage / "train" / "labels" / "a.npy").write_bytes(b"")


def names(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, OSError])
def test_a_failed_run_leaves_nothing(tmp_path, error):
    out = tmp_path / "out"
    with pytest.raises((error, EyerenderError)), staged(out) as folder:  # noqa: PT012
        (folder / "half").write_text("x")
        raise error
    assert not out.exists()


@pytest.mark.parametrize("make", [fill, export])
def test_a_failed_overwrite_keeps_what_was_there(tmp_path, make):
    with staged(tmp_path) as folder:
        make(folder)
    before = names(tmp_path)
    with pytest.raises(RuntimeError), staged(tmp_path, overwrite=True) as folder:  # noqa: PT012
        (folder / "half").write_text("x")
        raise RuntimeError
    assert names(tmp_path) == before


def test_overwrite_replaces_all_of_what_was_made_here(tmp_path):
    for make in (fill, export, export, lambda stage: fill(stage, "b"), export):
        with staged(tmp_path, overwrite=True) as folder:
            make(folder)
    assert names(tmp_path) == [MARKER, "empty", "train", "train/labels", "train/labels/a.npy"]
    with staged(tmp_path, overwrite=True) as folder:
        fill(folder)
    assert names(tmp_path) == ["dataset.json", "images", "images/a.png", "metadata.jsonl"]


def home(folder):
    """A folder like somebody's home."""
    (folder / ".ssh").mkdir(parents=True)
    (folder / ".ssh" / "id_ed25519").write_text("key")
    (folder / "Documents").mkdir()
    (folder / "Documents" / "thesis.txt").write_text("years of work")


def writers(folder):
    """Everything that writes with --overwrite, up to the point where it would replace what is there."""
    scene = load_scene("quickstart")
    return [
        lambda: staged(folder, overwrite=True).__enter__(),
        lambda: clear(folder),
        lambda: render_folder(scene, folder, overwrite=True),
        lambda: study.run_study("blignaut2014", folder, eyes=["E1"], overwrite=True),
    ]


@pytest.mark.parametrize("k", range(4))
def test_overwrite_leaves_a_home_folder_alone(tmp_path, k):
    folder = tmp_path / "home"
    home(folder)
    before = names(folder)
    with pytest.raises(InputError, match="was not made by this package, so it is not overwritten"):
        writers(folder)[k]()
    assert names(folder) == before


@pytest.mark.parametrize("k", range(4))
@pytest.mark.parametrize(
    "foreign", ["Documents/thesis.txt", "images/notes.txt", "images/sub/a.png", "masks/7/own.doc", "a.png", ".part"]
)
def test_overwrite_refuses_a_folder_of_ours_with_somebody_elses_files(tmp_path, foreign, k):
    with staged(tmp_path) as folder:
        fill(folder)
    (tmp_path / foreign).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / foreign).write_text("years of work")
    before = names(tmp_path)
    with pytest.raises(InputError, match=r"holds '.*', which this package did not make") as caught:
        writers(tmp_path)[k]()
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == before


def test_a_link_is_never_followed(tmp_path):
    home(tmp_path / "home")
    folder = tmp_path / "folder"
    with staged(folder) as stage:
        fill(stage)
    links = {".partial-12": "", "masks": "Documents", "images/b.png": "Documents/thesis.txt", "log.jsonl": ".ssh"}
    for name, target in links.items():
        (folder / name).symlink_to(tmp_path / "home" / target)
        with pytest.raises(InputError, match=f"holds '{name}', which this package did not make"):
            clear(folder)
        (folder / name).unlink()
    clear(folder)
    assert names(folder) == []
    assert names(tmp_path / "home") == [".ssh", ".ssh/id_ed25519", "Documents", "Documents/thesis.txt"]


def test_a_marker_lists_only_what_lies_inside(tmp_path):
    """Somebody else's marker cannot make us remove what is not in the folder."""
    (tmp_path / "thesis.txt").write_text("years of work")
    folder = tmp_path / "folder"
    folder.mkdir()
    data = {"schema": "eyerender/folder/1", "files": ["../thesis.txt", "/etc/passwd", 3, None, "link/thesis.txt"]}
    (folder / MARKER).write_text(json.dumps(data))
    clear(folder)
    (folder / MARKER).write_text(json.dumps(data))
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="holds 'link'"):
        clear(folder)
    assert (tmp_path / "thesis.txt").exists()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"schema": "other/1"}', '{"schema": "eyerender/dataset/1"', "["])
def test_a_damaged_sign_is_no_sign(tmp_path, text):
    for name in (MARKER, "dataset.json", "run.json", "study.json", "results.json"):
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match="was not made by this package"):
        clear(tmp_path)


def test_what_the_rooms_write_can_be_replaced(tmp_path):
    """The names that the rooms above give their files are the known ones."""
    kinds = [f"{kind}/00000/s0.png" for kind in KINDS]
    shards = [f"{SHARDS}/00000/{name}" for name in (LINES, DONE)]
    whole = [LOG, assemble.FAILURES, assemble.CARD, croissant.CROISSANT, "run.json", "metadata.jsonl"]
    dataset = [*kinds, *shards, *whole, f"{assemble.FAILURES}.part", f".{assemble.CARD}.0123abcd.part"]
    results = ["summary.json", "summary.csv", "findings.json", "findings.csv", study.REPORT]
    results += ["waterfall.csv", "leds.csv", "who.csv"]
    for name in [*dataset, *(f"images/{name}" for name in dataset), *results, study.MARKER, f"images/{LOCK}"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "images" / ".partial-00003-0123456789ab" / "images").mkdir(parents=True)
    with pytest.raises(InputError, match="was not made by this package"):
        clear(tmp_path)
    (tmp_path / shards[1]).write_text('{"schema": "eyerender/shard/1"}')
    clear(tmp_path)
    assert names(tmp_path) == []


@pytest.mark.parametrize("first", [fill, export])
@pytest.mark.parametrize("second", [fill, export])
def test_an_overwrite_killed_at_any_step_can_be_done_again(tmp_path, monkeypatch, first, second):
    """A kill is simulated by an exception that nothing catches, before each change of the folder's names."""

    class Killed(BaseException):
        pass

    def kill_before(step):
        count = 0

        def counted(change):
            def changed(*args, **keys):
                nonlocal count
                count += 1
                if count == step:
                    raise Killed
                return change(*args, **keys)

            return changed

        for owner, name in ((os, "rename"), (os, "replace"), (Path, "unlink"), (Path, "rmdir")):
            monkeypatch.setattr(owner, name, counted(getattr(owner, name)))

    step = 0
    while True:
        step += 1
        folder = tmp_path / str(step)
        with staged(folder) as stage:
            first(stage)
        kill_before(step)
        try:
            with staged(folder, overwrite=True) as stage:
                second(stage)
        except Killed:
            monkeypatch.undo()
        else:
            monkeypatch.undo()
            break
        with staged(folder, overwrite=True) as stage:
            second(stage)
        assert [n for n in names(folder) if not n.startswith(LOCK)] == names_of(second, tmp_path / f"{step}-alone")
    assert step > 5


def names_of(make, folder):
    with staged(folder) as stage:
        make(stage)
    return names(folder)


def test_leftovers_of_a_killed_run_do_not_block_the_next(tmp_path):
    (tmp_path / ".partial-99").mkdir()
    (tmp_path / LOCK).write_text("")
    refuse_non_empty(tmp_path, overwrite=False)
    with staged(tmp_path) as folder:
        fill(folder)
    assert names(tmp_path) == ["dataset.json", "images", "images/a.png", "metadata.jsonl"]


def test_taken_places_are_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is not empty; choose another folder or give --overwrite"):
        refuse_non_empty(tmp_path, overwrite=False)
    with pytest.raises(InputError, match="exists and is not a folder"):
        refuse_non_empty(tmp_path / "file", overwrite=True)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_second_writer_is_refused_and_the_first_goes_on(tmp_path, overwrite):
    out = tmp_path / "out"
    with staged(out, overwrite=overwrite) as stage:
        for _ in range(2):
            with pytest.raises(InputError, match="another run is using this folder"):
                staged(out, overwrite=overwrite).__enter__()
        with pytest.raises(InputError, match="another run is using"), run_lock(out, (1, 2), print):
            pass
        fill(stage)
    assert names(out) == ["dataset.json", "images", "images/a.png", "metadata.jsonl"]


def test_render_and_study_take_the_lock(tmp_path):
    with writer_lock(tmp_path):
        with pytest.raises(InputError, match="another run is using"):
            render_folder(load_scene("quickstart"), tmp_path)
        with pytest.raises(InputError, match="another run is using"):
            study.run_study("blignaut2014", tmp_path, eyes=["E1"])
    assert names(tmp_path) == []


def test_a_lock_whose_file_was_removed_holds_nobody(tmp_path, monkeypatch):
    """The first writer removes the lock's file just before the second, which has it open, locks it."""
    flock = fcntl.flock
    calls: list[int] = []

    def late(file, how):
        if not calls:
            (tmp_path / LOCK).unlink()
        calls.append(how)
        return flock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with writer_lock(tmp_path):
        assert len(calls) == 2
        with pytest.raises(InputError, match="another run is using"), writer_lock(tmp_path):
            pass


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="mounting a tmpfs needs root")
def test_a_full_disk_is_one_error_and_leaves_nothing(tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", small], capture_output=True)
    if mounted.returncode != 0:
        pytest.skip("this machine does not let a tmpfs be mounted")
    try:
        with (
            pytest.raises(EyerenderError, match=r"small/out/a\.png.*No space left on device"),
            staged(small / "out") as folder,
        ):
            write_png(folder / "a.png", np.random.default_rng(3).integers(0, 65536, (400, 400)).astype(np.uint16))
        assert list(small.iterdir()) == []
    finally:
        subprocess.run(["umount", small], check=True)
