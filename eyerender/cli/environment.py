"""Commands about the installation: doctor, setup-llvm, schema."""

from __future__ import annotations

import dataclasses
import json as jsonlib
from typing import Literal

from .app import app
from .options import Result
from .output import emit, say


@app.command(name="doctor")
def doctor(*, json: Result = None) -> int:
    """Show which backends can render here, and how to fix those that cannot.

    The exit code is 3 if no backend can render.
    """
    from ..backends.doctor import doctor_report

    report = doctor_report()
    lines = []
    for state in report.backends:
        lines.append(f"{state.name:<5} {'works' if state.ok else 'does not work'}: {state.detail}")
        if not state.ok:
            lines.append(f"      fix: {state.fix}")
    lines.append(
        f"rendering uses {report.chosen}"
        if report.chosen
        else "no backend can render here; analysis and extraction work"
    )
    lines += [f"python   {report.python}", f"platform {report.platform}", f"cpu      {report.cpu}"]
    lines += [f"{name} {version}" for name, version in report.packages]
    lines.append(f"cache    {report.cache}")
    emit({"schema": "eyerender/doctor/2", **dataclasses.asdict(report)}, "\n".join(lines), json)
    return 0 if report.ok else 3


@app.command(name="setup-llvm")
def setup_llvm() -> int:
    """Find a libLLVM that renders on the CPU, or print how to install one.

    On Debian and Ubuntu it also fetches the library libatomic if that is missing, without root rights.
    """
    from ..backends.set_up import setup_llvm as bring

    found = bring(say=say)
    print(f"libLLVM {found.version} works: {found.path}")
    return 0


@app.command(name="schema")
def schema(name: Literal["scene", "eye", "dataset"] = "scene", /) -> int:
    """Print the JSON Schema of a scene, eye or dataset file.

    Editors use it to complete and check the file.

    Args:
        name: The kind of file.
    """
    if name == "scene":
        from ..scene.spec import SceneSpec

        text = SceneSpec.json_schema()
    elif name == "dataset":
        from ..dataset.spec import DatasetSpec

        text = DatasetSpec.json_schema()
    else:
        from ..eye.spec import EyeSpec

        text = EyeSpec.json_schema()
    print(jsonlib.dumps(text, indent=1))
    return 0
