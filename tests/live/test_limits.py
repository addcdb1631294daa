"""The live page's limits: how many pages it keeps, and how soon Ctrl-C ends it whatever is connected."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import queue
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest
import yaml

from eyerender.scene import shipped_scenes

pytestmark = [
    pytest.mark.render,
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("nicegui") is None, reason="needs NiceGUI; run ./scripts/test-live"),
]
ROOT = Path(__file__).resolve().parents[2]
ENDS_S = 2.0


class Live:
    """A running live page that tells what it holds."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        address = process.stdout.readline().strip()
        assert process.stdout.readline() == "Ctrl-C ends it.\n"
        self.port, self.token = int(address.split(":")[2].split("/")[0]), address.rstrip("/").rpartition("/")[2]

    def counts(self) -> dict[str, Any]:
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        if not select.select([self.process.stdout], [], [], 60)[0]:
            self.process.send_signal(signal.SIGUSR1)  # `live` shows the stacks
            time.sleep(1)
            pytest.fail("the server does not answer")
        return json.loads(self.process.stdout.readline())

    def asking(self, path: str = "/", end: str = "Connection: close\r\n\r\n") -> socket.socket:
        """A connection on which a page is asked for; without the `end`, not completely."""
        line = socket.create_connection(("127.0.0.1", self.port), timeout=60)
        line.sendall(f"GET /{self.token}{path} HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\n{end}".encode())
        return line

    def page(self, path: str = "/") -> tuple[int, str]:
        """Status and text of a page."""
        with self.asking(path) as line, line.makefile("rb") as file:
            head, _, text = file.read().decode(errors="replace").partition("\r\n\r\n")
        return int(head.split(" ")[1]), text

    @contextlib.contextmanager
    def tab(self) -> Iterator[queue.Queue[str]]:
        """A page with its WebSocket, as a browser opens them; yields what it is sent."""
        from websockets.sync.client import connect

        client = re.search(r"[\"']client_id[\"']: *[\"']([0-9a-f-]{36})", self.page()[1])[1]
        query = {"EIO": "4", "transport": "websocket", "client_id": client, "tab_id": client, "document_id": client}
        address = f"ws://127.0.0.1:{self.port}/{self.token}/_nicegui_ws/socket.io/?"
        query |= {"implicit_handshake": "true", "next_message_id": "0"}
        with connect(address + urlencode(query), origin=f"http://127.0.0.1:{self.port}") as talk:
            assert talk.recv(timeout=30).startswith("0")
            talk.send("40")
            assert talk.recv(timeout=30).startswith("40")
            sent: queue.Queue[str] = queue.Queue()

            def listen() -> None:
                with contextlib.suppress(Exception):  # until it is closed
                    for message in talk:
                        if message == "2":  # a ping
                            talk.send("3")
                        sent.put(str(message))

            threading.Thread(target=listen, daemon=True).start()
            yield sent

    def ends_s(self) -> float:
        """Time from Ctrl-C until the process has ended."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(30) == 130
        return time.monotonic() - began


@contextlib.contextmanager
def live(scene: str) -> Iterator[Live]:
    command = [sys.executable, "-m", "tests.support.live_counts", scene]
    pipe = subprocess.PIPE
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=errors, text=True) as process,
    ):
        try:
            yield Live(process)
        finally:
            process.kill()
            process.wait()
            errors.seek(0)
            assert errors.read() == "interrupted\n" * (process.returncode == 130)


def until(what: Callable[[], bool], timeout_s: float) -> None:
    end = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < end
        time.sleep(0.5)


def picture_of(sent: queue.Queue[str]) -> str:
    """The address of the next picture that a tab is told to show."""
    while True:
        if found := re.search(r"/picture/[\w-]+\?[\d.]+", sent.get(timeout=120)):
            return found[0]


def test_pages_without_a_websocket_are_few_and_soon_deleted():
    with live("headset") as server:
        server.page()
        before = server.counts()["memory_mb"]
        answers = [server.page() for _ in range(200)]
        assert [status for status, _ in answers[:19]] == [200] * 19
        assert {status for status, _ in answers[19:]} <= {200, 503}
        assert answers[19][1] == "503: too many tabs: 20 are open; close one, wait 20 s and try again\n"
        held = server.counts()
        assert held["clients"] <= 20
        assert held["tabs"] <= 20
        # Twenty pages take 15 MB, two hundred took 250.
        assert held["memory_mb"] - before < 60
        assert server.page("/nothing")[0] == 404
        until(lambda: server.counts()["clients"] == 0, 60)
        until(lambda: server.counts()["tabs"] == 0, 10)
        assert server.page()[0] == 200


def test_a_tab_that_leaves_frees_its_pictures_at_once_and_its_page_later():
    with live("headset") as server:
        with server.tab() as sent:
            picture = picture_of(sent)
            assert server.page(picture)[0] == 200
            time.sleep(21)  # a page that has connected stays
            assert server.counts()["clients"] == 1
        until(lambda: server.page(picture)[0] == 404, 10)
        assert server.counts()["clients"] == 1
        until(lambda: server.counts()["clients"] == 0, 60)
        until(lambda: server.counts()["tabs"] == 0, 10)


def heavy(place: Path) -> str:
    """A scene whose pictures take long."""
    data = yaml.safe_load(shipped_scenes()["desktop_tracker"].read_text(encoding="utf-8"))
    data["region"] = {}
    data["image"] = {"window_px": [640, 480]}
    path = place / "heavy.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


def test_ctrl_c_ends_it_soon_with_nothing_connected():
    with live("headset") as server:
        assert server.ends_s() < ENDS_S


def test_ctrl_c_ends_it_soon_with_half_open_connections():
    with live("headset") as server:
        silent = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(20)]
        halves = [server.asking(end="X-Slow: ") for _ in range(20)]
        kept = [server.asking(end="\r\n") for _ in range(5)]
        time.sleep(1)
        assert server.ends_s() < ENDS_S
        for line in silent + halves + kept:
            line.close()


def test_ctrl_c_ends_it_soon_with_open_websockets():
    with live("headset") as server, contextlib.ExitStack() as stack:
        tabs = [stack.enter_context(server.tab()) for _ in range(3)]
        for sent in tabs:
            picture_of(sent)
        assert server.ends_s() < ENDS_S


def test_ctrl_c_ends_it_soon_while_a_picture_is_rendered(tmp_path):
    with live(heavy(tmp_path)) as server, server.tab():
        time.sleep(1)  # the first picture, with the compilation of its kernels, takes longer
        assert server.ends_s() < ENDS_S


def test_ctrl_c_ends_it_soon_while_pages_are_made():
    with live("headset") as server, contextlib.ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(server.asking())
        assert server.ends_s() < ENDS_S
