"""The script for SLURM arrays: which part of the shards a task makes."""

from __future__ import annotations

import os
import subprocess

import pytest

from tests.support.paths import TOOLS

SCRIPT = TOOLS / "slurm_generate.sh"

pytestmark = pytest.mark.skipif(not SCRIPT.is_file(), reason="not a checkout")


@pytest.mark.parametrize(
    ("task", "part"),
    [
        ({"ID": "7", "MIN": "1", "COUNT": "32"}, "7/32"),
        ({"ID": "0", "MIN": "0", "COUNT": "8"}, "1/8"),
        ({"ID": "9", "MIN": "1", "STEP": "4", "COUNT": "8"}, "3/8"),
    ],
)
def test_tasks_share_the_shards(task, part):
    assert submit({f"SLURM_ARRAY_TASK_{k}": v for k, v in task.items()}) == ["generate", "S", "D", "--shard", part]


def test_a_task_submitted_alone_makes_its_own_part():
    task = {"SLURM_ARRAY_TASK_ID": "9", "SLURM_ARRAY_TASK_MIN": "7", "SLURM_ARRAY_TASK_COUNT": "2"}
    assert submit(task | {"EYERENDER_PARTS": "32"}) == ["generate", "S", "D", "--shard", "9/32"]


def submit(task):
    done = subprocess.run(
        ["sh", str(SCRIPT), "S", "D", "--count", "3"],
        env={"PATH": os.environ["PATH"], "EYERENDER": "echo", "SLURM_CPUS_PER_TASK": "4", **task},
        capture_output=True,
        text=True,
        check=True,
    )
    words = done.stdout.split()
    assert words[5:] == ["--threads", "4", "--count", "3"]
    return words[:5]
