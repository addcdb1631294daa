"""A live page that tells what it holds: `python -m tests.support.live_counts SCENE`.

For each line on stdin it collects garbage, and prints as JSON the number of NiceGUI's clients, the number of tabs in
memory, and the resident memory in MB. SIGUSR1 makes it write down what its threads are doing.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import signal
import sys
import threading
from pathlib import Path

from nicegui import Client, core

from eyerender.apps.live.page import Tab
from eyerender.cli.main import run


def report() -> None:
    """Print what is held, in the thread that makes and deletes pages."""
    gc.collect()
    tabs = sum(type(thing) is Tab for thing in gc.get_objects())
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    memory = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    print(json.dumps({"clients": len(Client.instances), "tabs": tabs, "memory_mb": memory}), flush=True)


def listen() -> None:
    for _ in sys.stdin:
        core.loop.call_soon_threadsafe(report)


if __name__ == "__main__":
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    threading.Thread(target=listen, daemon=True).start()
    sys.exit(run(["live", sys.argv[1]]))
