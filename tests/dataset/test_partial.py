"""Partial shards: what is finished survives the end of a worker, and the bytes are those of an undisturbed run."""

from __future__ import annotations

import json
import signal
import time

import pytest

from eyerender.dataset import partial
from eyerender.dataset.maker import Maker
from eyerender.dataset.realise import frames_of
from eyerender.dataset.shard import Stopped, commit, write_shard
from tests.support.dataset_specs import command, make, plan, tree, write

pytestmark = pytest.mark.render
SHARD = 12
LARGE = {"shard_size": SHARD}


class Counted(Maker):
    """A maker that knows which samples it made."""

    made: list[int]

    def make_all(self, indices):
        for sample in super().make_all(indices):
            self.made.append(sample.index)
            yield sample


@pytest.fixture(scope="module")
def maker():
    made = plan(**LARGE)
    found = Counted(made, frames_of(made), threads=1)
    found.made = []
    return found


@pytest.fixture(scope="module")
def whole(maker, tmp_path_factory):
    """The first shard, made without an interruption."""
    folder = tmp_path_factory.mktemp("whole")
    commit(folder, write_shard(maker, folder, 0, lambda *_: None))
    return folder


@pytest.fixture
def fresh(maker):
    maker.made = []
    return maker


def stopped(maker, folder, after):
    """Make a shard until `after` samples are begun; returns the checkpoint."""
    asked = []

    def stop():
        asked.append(1)
        return len(asked) > after

    with pytest.raises(Stopped):
        write_shard(maker, folder, 0, lambda *_: None, stop)
    (stage,) = folder.glob(".partial-00000-*")
    return stage, json.loads((stage / "done.json").read_text())


def test_a_stopped_shard_goes_on_where_it_was(fresh, whole, tmp_path):
    stage, done = stopped(fresh, tmp_path, 3)
    assert done["images"] == 3  # what was begun is finished
    assert len(done["files"]) == 7
    (stage / "images" / "000007_right.png").write_bytes(b"after the checkpoint")
    with open(stage / "shard" / "lines.jsonl", "a") as file:
        file.write('{"sample": 7, "cut')
    seen = []
    commit(tmp_path, write_shard(fresh, tmp_path, 0, lambda *numbers: seen.append(numbers)))
    assert fresh.made == list(range(SHARD))
    assert seen == [(3, 0), *((k, 1) for k in range(4, SHARD + 1))]
    assert tree(tmp_path) == tree(whole)
    assert [p.name for p in tmp_path.glob(".partial-*")] == []
    own, other = (json.loads((f / "shards" / "00000" / "done.json").read_text()) for f in (tmp_path, whole))
    for found in (own, other):
        del found["seconds"]
    assert own == other


@pytest.mark.parametrize(
    "harm",
    [
        pytest.param(lambda stage: next((stage / "images").iterdir()).write_bytes(b""), id="picture"),
        pytest.param(lambda stage: next((stage / "masks").iterdir()).unlink(), id="missing", marks=pytest.mark.slow),
        pytest.param(lambda stage: (stage / "shard" / "lines.jsonl").write_bytes(b"{}\n"), id="lines"),
        pytest.param(lambda stage: (stage / "done.json").write_bytes(b"{"), id="checkpoint", marks=pytest.mark.slow),
        pytest.param(
            lambda stage: (stage / "done.json").write_text(
                (stage / "done.json").read_text().replace('"llvm"', '"cuda"').replace('"digest": "', '"digest": "0')
            ),
            id="other",
        ),
    ],
)
def test_a_damaged_checkpoint_or_another_plans_is_not_used(fresh, whole, tmp_path, harm):
    stage, _ = stopped(fresh, tmp_path, 2)
    harm(stage)
    commit(tmp_path, write_shard(fresh, tmp_path, 0, lambda *_: None))
    assert fresh.made == [0, 1, *range(SHARD)]
    partial.remove_stages(tmp_path, [0], {0})
    assert tree(tmp_path) == tree(whole)


@pytest.mark.parametrize(
    "name", ["shard", *(pytest.param(name, marks=pytest.mark.slow) for name in ("images", "masks"))]
)
def test_a_checkpoint_with_links_is_left_alone(fresh, whole, tmp_path, name):
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "thesis.doc").write_text("keep")
    folder = tmp_path / "run"
    stage = folder / ".partial-00000-x"
    stage.mkdir(parents=True)
    (stage / name).symlink_to(victim)
    done = json.loads((whole / "shards" / "00000" / "done.json").read_text())
    (stage / "done.json").write_text(json.dumps({**done, "files": {}}))
    commit(folder, write_shard(fresh, folder, 0, lambda *_: None))
    assert tree(folder / "images") == tree(whole / "images")
    assert not any(place.is_symlink() for place in (folder / "images").iterdir())
    assert [place.name for place in victim.iterdir()] == ["thesis.doc"]


def test_a_finished_shard_with_strange_names_is_set_aside(fresh, whole, tmp_path):
    lines = tmp_path / "shards" / "00000"
    lines.mkdir(parents=True)
    done = json.loads((whole / "shards" / "00000" / "done.json").read_text())
    sums = {"bytes": 1, "sha256": "x"}
    (lines / "done.json").write_text(json.dumps({**done, "files": {"images/00000/abc.png": sums}}))
    commit(tmp_path, write_shard(fresh, tmp_path, 0, lambda *_: None))
    assert tree(tmp_path / "images") == tree(whole / "images")


def test_folders_in_a_checkpoint_do_not_stop_a_run(fresh, whole, tmp_path):
    stage = tmp_path / ".partial-00000-x"
    (stage / "images" / "sub").mkdir(parents=True)
    done = json.loads((whole / "shards" / "00000" / "done.json").read_text())
    (stage / "done.json").write_text(json.dumps({**done, "files": {}}))
    commit(tmp_path, write_shard(fresh, tmp_path, 0, lambda *_: None))
    assert tree(tmp_path / "images") == tree(whole / "images")


def test_a_killed_worker_loses_what_came_after_the_checkpoint(fresh, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(partial, "CHECKPOINT_S", 0.0)

    class Killed(BaseException):
        pass

    def sample(samples, _images):
        monkeypatch.setattr(partial, "CHECKPOINT_S", 100.0 if samples >= 5 else 0.0)
        if samples == 8:
            raise Killed

    with pytest.raises(Killed):
        write_shard(fresh, tmp_path, 0, sample)
    assert partial.checkpoints(tmp_path) == {0: 5}
    commit(tmp_path, write_shard(fresh, tmp_path, 0, lambda *_: None))
    assert fresh.made == [*range(8), *range(5, SHARD)]
    assert tree(tmp_path) == tree(whole)


def pictures(folder):
    try:
        return sum(1 for _ in folder.glob("**/images/**/*.png"))
    except FileNotFoundError:  # a folder was renamed meanwhile
        return 0


def kept(folder):
    """Images in finished shards and in checkpoints."""
    done = [json.loads(path.read_text())["images"] for path in folder.glob("shards/*/done.json")]
    return sum(done) + sum(partial.checkpoints(folder).values())


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_run_that_never_lives_as_long_as_a_shard_gets_finished(tmp_path, number):
    """SIGTERM loses at most the picture that is being written; SIGKILL what came after the last checkpoint."""
    if number == signal.SIGTERM:
        big = {"count": 60, "shard_size": 30, "subjects": 2, "scene.image.spp": 32}
    else:  # samples so slow that a checkpoint comes before the end of a shard
        big = {"count": 24, "shard_size": 12, "subjects": 2, "scene.image.spp": 1500}
    spec, folder, rounds, had = write(tmp_path / "tiny.yaml", **big), tmp_path / "out", 0, 0
    while True:
        process = command("generate", str(spec), str(folder), "--workers", "2", start_new_session=True)
        start = time.monotonic()
        while process.poll() is None and (kept(folder) <= had or number == signal.SIGTERM):
            time.sleep(0.2)
            if number == signal.SIGTERM and pictures(folder) >= had + 12 and time.monotonic() - start > 1.0:
                break
        there = pictures(folder)
        process.send_signal(number)
        process.communicate(timeout=60)
        if process.returncode == 0:
            break
        assert process.returncode == (130 if number == signal.SIGTERM else -signal.SIGKILL)
        time.sleep(2.0)  # workers notice that their parent is gone
        now, rounds = kept(folder), rounds + 1
        assert now >= (there - 2 if number == signal.SIGTERM else had + 1)
        had = now
        assert rounds < 60
    assert rounds >= 1
    make(tmp_path / "undisturbed", plan(**big), workers=2, threads=2)
    assert tree(folder) == tree(tmp_path / "undisturbed")
