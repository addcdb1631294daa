"""The live page in a real browser, and attacks on its real server. See scripts/test-live."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

import eyerender as er
from _browser import WATCH, chromium, find_chromium, latency_s, live_server, pictured, press, resize, until

pytestmark = [
    pytest.mark.render,
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("nicegui") is None, reason="needs NiceGUI; run ./scripts/test-live"),
]
in_a_browser = pytest.mark.skipif(
    find_chromium() is None or importlib.util.find_spec("selenium") is None,
    reason="needs Chromium, its driver and Selenium; run ./scripts/test-live",
)


@pytest.fixture(scope="module")
def server():
    with live_server("headset") as server:
        yield server


def talk(port, *lines):
    """First bytes of the answer to a raw request."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
        line.sendall("\r\n".join([*lines, "Connection: close", "", ""]).encode())
        answer = b""
        while chunk := line.recv(65536):
            answer += chunk
            if b"\r\n\r\n" in answer and b" 101 " in answer.split(b"\r\n")[0]:
                break
        return answer


def status(port, *lines):
    return int(talk(port, *lines).split(b" ")[1])


def upgrade(server, *headers, path=None):
    """Status of a WebSocket's handshake."""
    path = path or f"/{server.token}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    keys = ("Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Upgrade: websocket")
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as line:
        line.sendall("\r\n".join([f"GET {path} HTTP/1.1", *headers, *keys, "Connection: Upgrade", "", ""]).encode())
        return int(line.recv(4096).split(b" ")[1])


def test_the_server_answers_nobody_but_its_page(server):
    home, own = f"GET /{server.token}/ HTTP/1.1", f"Host: 127.0.0.1:{server.port}"
    assert status(server.port, home, own) == 200
    assert status(server.port, home, "Host: localhost:9999") == 200  # SSH forwards another port
    for request in ("GET /", "GET /x/", "GET /_nicegui/", "GET /socket.io/?EIO=4", f"GET /{server.token[:-1]}/"):
        answer = talk(server.port, f"{request} HTTP/1.1", own)
        assert b" 403 " in answer.split(b"\r\n")[0]
        assert server.token.encode() not in answer
    assert status(server.port, home, "Host: evil.example") == 403
    assert status(server.port, home, own, "Origin: http://evil.example") == 403
    assert status(server.port, home.replace("GET", "POST"), own, "Content-Length: 0") == 403
    assert status(server.port, home) in (400, 403)  # no Host at all


def test_its_websocket_answers_nobody_but_its_page(server):
    own = f"Host: 127.0.0.1:{server.port}"
    assert upgrade(server, own, f"Origin: http://127.0.0.1:{server.port}") == 101
    assert upgrade(server, "Host: localhost:9999", "Origin: http://localhost:9999") == 101
    assert upgrade(server, own) == 403
    assert upgrade(server, own, "Origin: http://evil.example") == 403
    assert upgrade(server, own, "Origin: null") == 403
    assert upgrade(server, "Host: evil.example", "Origin: http://evil.example") == 403
    wrong = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    assert upgrade(server, own, f"Origin: http://127.0.0.1:{server.port}", path=wrong) == 403


def test_no_path_leads_to_a_file_of_the_machine(server):
    own, root = f"Host: 127.0.0.1:{server.port}", f"/{server.token}"
    for climb in (
        "/../../../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/..%2f..%2f..%2fetc%2fpasswd",
        "//etc/passwd",
    ):
        for start in ("", "/_nicegui/3.18.0/static", "/_nicegui/3.18.0/components", "/picture"):
            answer = talk(server.port, f"GET {root}{start}{climb} HTTP/1.1", own)
            assert b"root:" not in answer
            assert not answer.startswith(b"HTTP/1.1 5")
    assert status(server.port, f"GET {root}/picture/guess HTTP/1.1", own) == 404


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux' table of sockets")
def test_it_listens_on_the_loopback_alone(server):
    with Path("/proc/net/tcp").open() as file:
        table = [line.split() for line in list(file)[1:]]
    mine = [row[1].split(":") for row in table if row[3] == "0A" and int(row[1].split(":")[1], 16) == server.port]
    assert mine == [["0100007F", f"{server.port:04X}"]]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(number):
    with live_server("head_mounted") as server:
        port = server.port
        server.process.send_signal(number)
        assert server.process.wait(30) == 130
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free.bind(("127.0.0.1", port))


def test_a_port_that_is_taken_is_one_line(server):
    command = [sys.executable, "-m", "eyerender", "live", "headset", "--port", str(server.port)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ, timeout=120)
    assert done.returncode == 2
    assert done.stderr == f"error: --port: {server.port} cannot be used (Address already in use)\n"


@contextlib.contextmanager
def forwarded(port):
    """Another port of this machine that leads to the server's, as `ssh -L` makes it."""

    def carry(source, sink):
        with contextlib.suppress(OSError):
            while chunk := source.recv(65536):
                sink.sendall(chunk)
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_WR)

    def accept():
        with contextlib.suppress(OSError):
            while True:
                near = listener.accept()[0]
                far = socket.create_connection(("127.0.0.1", port))
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=carry, args=pair, daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=accept, daemon=True).start()
        yield listener.getsockname()[1]


def text(driver, selector):
    return driver.execute_script("return document.querySelector(arguments[0])?.innerText ?? ''", selector)


def click(driver, name):
    driver.execute_script(
        "[...document.querySelectorAll('button')].find((b) => b.innerText.trim() === arguments[0]).click()", name
    )


def typed(driver, name, value):
    """Write a number into the field of a knob."""
    field = driver.find_element("css selector", f'input[aria-label="{name}, exact"]')
    driver.execute_script(
        "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input', {bubbles: true}))",
        field,
        value,
    )


@in_a_browser
def test_the_page_follows_refines_and_saves(server):
    with chromium() as driver:
        driver.get(server.address)
        until(lambda: pictured(driver), 120)
        driver.execute_script(WATCH)
        assert latency_s(driver, "Pupil", "ArrowRight", 60) > 0
        assert "samples per pixel" in text(driver, ".status")
        until(lambda: "· 64 samples" in text(driver, ".status"), 120)
        assert text(driver, ".problem") == ""

        marks = "return [...document.querySelectorAll('.frame svg g.' + arguments[0] + ' ellipse')].length"
        assert driver.execute_script(marks, "analytic") == 1
        assert driver.execute_script(marks, "found") == 1
        assert "pupil" in text(driver, ".features")

        click(driver, "Save YAML")
        click(driver, "Save Python")
        until(lambda: {p.suffix for p in driver.downloads.glob("headset.*")} == {".yaml", ".py"}, 30)
        saved = er.load_scene(driver.downloads / "headset.yaml").spec
        assert saved.eye.pupil_diameter_mm == pytest.approx(4.1)
        names: dict[str, Any] = {"__name__": "saved"}
        exec((driver.downloads / "headset.py").read_text(), names)
        assert names["scene"].spec == saved
        assert yaml.safe_load((driver.downloads / "headset.yaml").read_text())["name"] == "headset"

        errors = [line for line in driver.get_log("browser") if line["level"] == "SEVERE"]
        assert errors == []
        asked = [m["message"] for m in driver.get_log("performance") if '"Network.requestWillBeSent"' in m["message"]]
        own = f"http://127.0.0.1:{server.port}/{server.token}/"
        urls = [part.split('"')[0] for m in asked for part in m.split('"url":"')[1:2]]
        outside = [url for url in urls if not url.startswith((own, "data:", "blob:", "chrome"))]
        assert outside == []


@in_a_browser
def test_the_page_works_through_another_port(server):
    with forwarded(server.port) as port, chromium() as driver:
        driver.get(f"http://localhost:{port}/{server.token}/")
        until(lambda: pictured(driver), 120)
        driver.execute_script(WATCH)
        assert latency_s(driver, "Pupil", "ArrowRight", 60) > 0


@in_a_browser
def test_bad_input_is_a_line_and_the_page_goes_on(server):
    with chromium() as driver:
        driver.get(server.address)
        until(lambda: pictured(driver), 120)
        driver.execute_script(WATCH)
        typed(driver, "Pupil", "-3")
        assert "eye.pupil_diameter_mm: must be > 0" in until(lambda: text(driver, ".problem"), 30)
        typed(driver, "x, to the screen", "-5")  # of the LED, which is then behind the cornea
        typed(driver, "y, to the subject's left", "-31.5")
        typed(driver, "z, up", "0")
        assert until(lambda: "the lamp is in the right eye" in text(driver, ".problem"), 30)
        click(driver, "Start again")
        until(lambda: text(driver, ".problem") == "", 30)
        assert latency_s(driver, "Elevation, up", "ArrowLeft", 60) > 0


@in_a_browser
@pytest.mark.parametrize("width", [1440, 900, 390])
def test_nothing_is_wider_than_the_page(server, width):
    with chromium(width, 844) as driver:
        driver.get(server.address)
        until(lambda: pictured(driver), 120)
        resize(driver, width, 844)
        assert driver.execute_script("return document.documentElement.scrollWidth") <= width


@in_a_browser
def test_tabs_are_independent_and_a_closed_one_is_freed(server):
    with chromium() as driver:
        driver.get(server.address)
        until(lambda: pictured(driver), 120)
        first = driver.current_window_handle
        picture = driver.execute_script("return document.querySelector('.frame img').src")
        driver.switch_to.new_window("tab")
        driver.get(server.address)
        until(lambda: pictured(driver), 120)
        driver.execute_script(WATCH)
        other = driver.execute_script("return document.querySelector('.frame img').src")
        for _ in range(3):
            press(driver, "Pupil", "ArrowRight")
        until(lambda: driver.execute_script("return Math.max(...window.seen.map((s) => s[1]))") > 1, 60)
        assert talk(server.port, f"GET {_path(other)} HTTP/1.1", f"Host: 127.0.0.1:{server.port}").startswith(
            b"HTTP/1.1 200"
        )
        driver.close()
        driver.switch_to.window(first)
        assert _path(picture) != _path(other)
        end = time.monotonic() + 60
        while status(server.port, f"GET {_path(other)} HTTP/1.1", f"Host: 127.0.0.1:{server.port}") != 404:
            assert time.monotonic() < end
            time.sleep(1)
        assert status(server.port, f"GET {_path(picture)} HTTP/1.1", f"Host: 127.0.0.1:{server.port}") == 200


def _path(url):
    return "/" + url.split("/", 3)[3].partition("?")[0]
