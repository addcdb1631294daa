"""The Ray engine on a real local cluster: the same bytes, and an actor that is killed at work."""

from __future__ import annotations

import os
import shutil
import signal
import threading

import pytest
from dataset_specs import make, plan, tree

from eyerender.dataset.cluster import RayEngine
from eyerender.dataset.realise import frames_of
from eyerender.dataset.shard import Staged
from eyerender.dataset.worker import Job

pytestmark = [pytest.mark.render, pytest.mark.slow]


def test_the_same_bytes_as_the_local_engine(tiny, tmp_path):
    pytest.importorskip("ray")
    make(tmp_path / "ray", plan(), engine="ray", workers=2, threads=2)
    assert tree(tmp_path / "ray") == tree(tiny)


def test_a_killed_actor_is_started_again_and_nothing_is_lost(tmp_path):
    pytest.importorskip("ray")
    made = plan(shard_size=6)
    retries, shards, killed, workers = [], [], [], set()

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
