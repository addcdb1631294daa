"""The command live: show a scene on an interactive page."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated

from cyclopts import Parameter

from ..base.errors import InputError
from .app import app
from .options import Backend, EyeModel, SceneName, Strict, Threads
from .output import Heed


@app.command(name="live")
def live(
    scene: SceneName,
    /,
    *,
    port: Annotated[int, Parameter(help="The port on 127.0.0.1 (default: a free one).")] = 0,
    browser: Annotated[bool, Parameter(help="Open the page in a browser of this machine.")] = False,
    eye: EyeModel = None,
    backend: Backend = "auto",
    threads: Threads = None,
    strict: Strict = False,
) -> int:
    """Show a scene on a local web page: its rig in 3-D, and its image, which follows your changes.

    The command prints the page's address, which holds a random token, and runs until Ctrl-C. It needs the extra `live`.
    """
    if find_spec("nicegui") is None:
        raise InputError("needs NiceGUI (the extra 'live'); run: pip install nicegui", source="live")
    from ..apps.live.server import serve

    loaded = Heed(strict).scene(scene, eye=eye)

    def announce(address: str) -> None:
        print(f"{address}\nCtrl-C ends it.", flush=True)
        if browser:
            import webbrowser

            webbrowser.open(address)

    serve(loaded, port=port, backend=backend, threads=threads, announce=announce)
    return 0
