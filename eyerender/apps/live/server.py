"""The live page's server, on 127.0.0.1 behind the guard."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

import uvicorn
from fastapi import FastAPI
from nicegui import ui

from ...backends.choose import BackendChoice
from ...base.errors import InputError
from ...scene import Scene
from .guard import Guard, new_token
from .page import Studio
from .painter import Painter

HOST = "127.0.0.1"
RECONNECT_S = 20.0
"""Time for which a tab may be disconnected, on a slow line or a busy machine, before it is deleted."""
_CLOSING_S = 0.4
"""Time for open connections to close at the end."""
_ENDING_S = 1.2
"""Longest time between Ctrl-C and the end of the process, even while it computes, renders or serves a tab."""


def serve(
    scene: Scene,
    *,
    port: int = 0,  # the port; 0 selects a free one
    backend: BackendChoice = "auto",  # the render backend
    threads: int | None = None,  # processor threads for rendering; None: all
    # called with the address (with its token) as soon as the page can be opened
    announce: Callable[[str], None] = print,
) -> None:
    """Show a scene on a local web page. An interrupt ends the process with exit code 130.

    Raises:
        InputError: the port is taken.
        BackendError: no backend renders.
    """
    with _listening(port) as listener:
        painter = Painter(backend=backend, threads=threads)
        deadline = threading.Timer(_ENDING_S, _end)
        deadline.daemon = True
        try:
            painter.start()
            _run(Studio(scene, painter, connect_s=RECONNECT_S), listener, announce, deadline)
        except KeyboardInterrupt:
            _end()
        finally:
            deadline.cancel()
            painter.close()


def _end() -> NoReturn:
    """End the process immediately.

    A normal exit would unload Mitsuba and LLVM, and wait for a running kernel, which cannot be interrupted.
    """
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    print("interrupted", file=sys.stderr, flush=True)
    os._exit(128 + signal.SIGINT)


@contextlib.contextmanager
def _listening(port: int) -> Iterator[socket.socket]:
    """Open a socket that listens only on the loopback interface."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        try:
            listener.bind((HOST, port))
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) else "must be between 0 and 65535"
            raise InputError(f"{port} cannot be used ({reason})", source="--port") from None
        yield listener
    finally:
        listener.close()


def _run(studio: Studio, listener: socket.socket, announce: Callable[[str], None], deadline: threading.Timer) -> None:
    token = new_token()
    inner = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    studio.register()
    ui.run_with(
        inner,
        reconnect_timeout=RECONNECT_S,
        message_history_length=100,
        show_welcome_message=False,
        tailwind=False,
        favicon="\N{EYE}",
    )
    logging.getLogger("nicegui").setLevel(logging.ERROR)
    config = uvicorn.Config(
        Guard(inner, token),
        log_level="critical",
        access_log=False,  # the addresses contain the token
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=_CLOSING_S,
        ws_max_size=2**20,
        h11_max_incomplete_event_size=2**16,
    )
    server = _Server(config, lambda: announce(f"http://{HOST}:{listener.getsockname()[1]}/{token}/"), deadline)
    asyncio.run(server.serve(sockets=[listener]))


class _Server(uvicorn.Server):
    """A server that reports when it is listening, and starts `deadline` when a signal ends it."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None], deadline: threading.Timer) -> None:
        super().__init__(config)
        self._ready, self._deadline = ready, deadline

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._ready()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if not self.should_exit:
            self._deadline.start()
        super().handle_exit(sig, frame)
