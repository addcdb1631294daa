"""The Ray engine on a real local cluster: the same bytes, and an actor that is killed at work."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path

import pytest

from eyerender.dataset.cluster import RayEngine
from eyerender.dataset.realise import frames_of
from eyerender.dataset.shard import Staged
from eyerender.dataset.worker import Job
from tests.support.dataset_specs import command, make, plan, tree, write

pytestmark = [pytest.mark.render, pytest.mark.slow]


def test_the_same_bytes_as_the_local_engine(tiny, tmp_path):
    pytest.importorskip("ray")
    make(tmp_path / "ray", plan(), engine="ray", workers=2, threads=2)
    assert tree(tmp_path / "ray") == tree(tiny)


def test_a_killed_actor_is_started_again_and_nothing_is_lost(tmp_path):
    pytest.importorskip("ray")
    made = plan(shard_size=6)
    retries: list = []
    shards: list = []
    killed: list[int] = []
    workers: set[int] = set()

    class Listener:
        def ready(self, backend, worker):
            pid = int(worker.rpartition(":")[2])
            workers.add(pid)
            if not killed:
                killed.append(pid)
                # A moment later, when it is at work on its next shard.
                threading.Timer(0.05, os.kill, (pid, signal.SIGKILL)).start()

        def sample(self, shard, samples, images):
            assert samples == 6

        def staged(self, staged, worker):
            assert isinstance(staged, Staged)
            shards.append(staged.shard)
            shutil.rmtree(staged.stage)

        def retry(self, shard, reason, tries):
            retries.append((shard, reason))

    job = Job.of(made, frames_of(made), tmp_path, "auto", 1)
    lost = RayEngine(job, 1).run([0, 1, 2, 3], Listener())
    assert lost == {}
    assert sorted(shards) == [0, 1, 2, 3]
    assert len(workers) == 2  # Ray started another in place of the killed one
    assert retries == []  # and had it make the shard


def processes(field, value):
    """The living processes whose parent (1) or session (3) is the given one."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            fields = (place / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[field]) == value and fields[0] != "Z":
            found.append(int(place.name))
    return found


def until(condition):
    """Wait for something that happens sooner or later."""
    deadline = time.monotonic() + 120
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


def driver_of(process):
    """The driver of a run: the child that leads a session."""
    return until(lambda: [pid for pid in processes(1, process.pid) if os.getsid(pid) == pid])[0]


@pytest.fixture
def started(tmp_path):
    """A run on Ray that has made a shard, and its driver."""
    pytest.importorskip("ray")
    spec, folder = write(tmp_path / "tiny.yaml"), tmp_path / "out"
    process = command("generate", str(spec), str(folder), "--engine", "ray", "--workers", "1", "--threads", "1")
    try:
        driver = driver_of(process)
        assert "generating" in process.stderr.readline()
        assert len(processes(3, driver)) > 3
        yield process, driver, folder
    finally:
        process.kill()
        process.communicate()


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="looks for processes in /proc")


@needs_proc
def test_sigterm_ends_a_run_on_ray_like_an_interrupt(started, tiny):
    process, driver, folder = started
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "interrupted"
    assert all(line.startswith(("generating: ", "interrupted")) or "are finished" in line for line in err.splitlines())
    assert processes(3, driver) == []
    # A slow actor may have stored a checkpoint of its shard.
    assert make(folder, plan())["complete"]
    assert not list(folder.glob(".partial-*"))
    assert tree(folder) == tree(tiny)


@needs_proc
def test_sigterm_while_ray_starts_leaves_nothing(tmp_path):
    pytest.importorskip("ray")
    spec = write(tmp_path / "tiny.yaml")
    process = command("generate", str(spec), str(tmp_path / "out"), "--engine", "ray", "--workers", "1")
    driver = driver_of(process)
    until(lambda: len(processes(3, driver)) > 1)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "interrupted"
    assert "Traceback" not in err
    assert processes(3, driver) == []


@needs_proc
def test_a_killed_run_leaves_no_process_of_ray(started):
    process, driver, _ = started
    process.kill()
    until(lambda: processes(3, driver) == [])


@needs_proc
def test_a_killed_driver_ends_the_run_with_one_line(started):
    process, driver, _ = started
    os.kill(driver, signal.SIGKILL)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert err.splitlines()[-1] == "error: Ray's driver was ended by SIGKILL"
    assert "Traceback" not in err
    assert processes(3, driver) == []
