#!/usr/bin/env python3
"""Bench of `eyerender rig`: time, growth and memory of bound, dropout and coverage in 81 directions.

    bench_rig.py [--quick] [--json F]

The command runs with two workers and without a sample of estimators. Its CPU time is that of all its processes; on two
idle cores it takes about half as long. Memory is the largest sum over its processes of the memory that each does not
share, plus its part of what they share.
"""

from __future__ import annotations

import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from _bench import Report, options_of, row, single_threaded

single_threaded()

SCENE = "headset"
SIZE = re.compile(r"^Pss: +(\d+) kB", re.MULTILINE)


def memory_mib(process: int) -> float:
    """Memory of a process and its descendants, in MiB."""
    try:
        found = SIZE.search(Path(f"/proc/{process}/smaps_rollup").read_text())
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return 0.0  # it has ended
    return (int(found[1]) / 1024 if found else 0.0) + sum(memory_mib(int(child)) for child in children)


def measured(people: int) -> tuple[float, float, float]:
    """Seconds, CPU seconds and largest memory (MiB) of a report on some people."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "eyerender", "rig", SCENE, "--people", str(people), "--sample", "0"]
        before, start, most = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter(), 0.0
        with subprocess.Popen([*command, "--workers", "2", "-o", f"{folder}/out"], stderr=subprocess.DEVNULL,
                              stdout=subprocess.DEVNULL) as run:  # fmt: skip
            while run.poll() is None:
                most = max(most, memory_mib(run.pid))
                time.sleep(0.2)
        whole, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if run.returncode != 0:
        sys.exit(f"error: {' '.join(command)} ended with {run.returncode}")
    return whole, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, most


def main() -> int:
    """Measure three sizes and print the rows."""
    options = options_of(__doc__, "take 200 people instead of 1,000").parse_args()
    most = 200 if options.quick else 1000
    report, cost = Report(), {}
    for people in (20, most // 5, most):
        whole, cpu, memory = measured(people)
        cost[people] = cpu
        report.add(row(f"{people} people", whole, "s"))
        report.add(row(f"{people} people, CPU of all processes", cpu, "s"))
        report.add(row(f"{people} people, memory of all processes", memory, "MiB", must=1000 / 1.048576))
    report.add(row(f"{most} people, CPU over two cores", cost[most] / 2, "s", 90.0 if most == 1000 else None))
    near, far = (cost[n] - cost[20] for n in (most // 5, most))
    growth = far / (most - 20) / (near / (most // 5 - 20))
    report.add(row(f"one more person, of {most} over of {most // 5}", growth, "ratio", 1.3))
    return report.finish(options.json, ("eyerender", "numpy"))


if __name__ == "__main__":
    sys.exit(main())
