"""A live page in a headless Chromium, for its tests and its bench."""

from __future__ import annotations

import contextlib
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--hide-scrollbars",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip


def find_chromium() -> tuple[str, str] | None:
    """Paths of Chromium and of its driver, where both are installed."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    return None if browser is None or driver is None else (browser, driver)


class LiveServer:
    """A running `eyerender live`: its process, and the address that it printed."""

    def __init__(self, process: subprocess.Popen[str], address: str) -> None:
        self.process, self.address = process, address

    @property
    def port(self) -> int:
        """Port of the page."""
        return int(self.address.split(":")[2].split("/")[0])

    @property
    def token(self) -> str:
        """Token in the address."""
        return self.address.rstrip("/").rpartition("/")[2]

    def memory_mb(self) -> float:
        """Resident memory of the process."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@contextlib.contextmanager
def live_server(scene: str, *options: str, timeout_s: float = 120) -> Iterator[LiveServer]:
    """Run `eyerender live SCENE` in this checkout, and end it as Ctrl-C does."""
    command = [sys.executable, "-m", "eyerender", "live", scene, *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines: queue.Queue[str] = queue.Queue()
    stdout = process.stdout

    def read() -> None:
        for line in stdout:
            lines.put(line)

    threading.Thread(target=read, daemon=True).start()
    try:
        yield LiveServer(process, lines.get(timeout=timeout_s).strip())
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()


@contextlib.contextmanager
def chromium(width: int = 1440, height: int = 900) -> Iterator[Any]:
    """A headless Chromium with software rendering of 3-D, driven by Selenium."""
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    found = find_chromium()
    assert found is not None
    options = Options()
    options.binary_location = found[0]
    with tempfile.TemporaryDirectory() as folder:
        for flag in (*_FLAGS, f"--user-data-dir={folder}/profile"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        driver = webdriver.Chrome(options=options, service=Service(found[1]))
        driver.downloads = Path(folder)
        behaviour = {"behavior": "allow", "downloadPath": folder}
        driver.execute_cdp_cmd("Browser.setDownloadBehavior", behaviour)
        try:
            resize(driver, width, height)
            yield driver
        finally:
            driver.quit()


def resize(driver: Any, width: int, height: int) -> None:
    """Give the page a size; a narrow one is a phone's."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 700}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def until(what: Callable[[], Any], timeout_s: float = 60) -> Any:
    """Wait until a call returns something true."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if value := what():
            return value
        time.sleep(0.02)
    raise TimeoutError


WATCH = """
const image = document.querySelector('.frame img');
const note = () => [performance.now(), ...new URL(image.src).search.slice(1).split('.').map(Number)];
window.seen = [note()];
image.addEventListener('load', () => window.seen.push(note()));
document.addEventListener('keydown', () => { window.pressed = performance.now(); }, true);
"""
"""Makes a page write down when each picture is shown (time, order, samples, coarseness) and when a key was pressed."""


def pictured(driver: Any) -> bool:
    """Whether the page shows a picture."""
    return bool(driver.execute_script("const i = document.querySelector('.frame img'); return i && i.naturalWidth > 0"))


def press(driver: Any, name: str, key: str) -> None:
    """Press a key on a slider by its name."""
    from selenium.webdriver.common.by import By

    slider = driver.find_element(By.CSS_SELECTOR, f'.q-slider[aria-label="{name}"] [tabindex]')
    driver.execute_script("arguments[0].focus()", slider)
    code = {"ArrowRight": 39, "ArrowLeft": 37}[key]
    for kind in ("keyDown", "keyUp"):
        event = {"type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code}
        driver.execute_cdp_cmd("Input.dispatchKeyEvent", event)


def latency_s(driver: Any, name: str, key: str, timeout_s: float = 20) -> float:
    """Time from a key on a slider until the first picture of the new scene is shown, on a page with `WATCH`."""
    before = int(driver.execute_script("return Math.max(0, ...window.seen.map((s) => s[1]))"))
    driver.execute_script("window.seen = window.seen.slice(-1)")
    press(driver, name, key)
    shown = "return window.seen.filter((s) => s[1] > arguments[0]).map((s) => s[0] - window.pressed)[0]"
    return float(until(lambda: driver.execute_script(shown, before), timeout_s)) / 1000
