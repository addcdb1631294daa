"""Near-infrared eye images through refractive corneas, with exact labels.

The public names below are all there is to import; they load their modules on first use, so `import eyerender` loads
neither Mitsuba nor OpenCV.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import gaze
    from .analytic.observer import AnalyticObserver
    from .benchmark.protocol import Extractor
    from .capture import render_windows
    from .comparison import Comparison, compare
    from .errors import BackendError, EyerenderError, InputError
    from .eye.catalogue import load_eye
    from .eye.model import EyeModel
    from .eye.spec import EyeSpec
    from .imagefolder import ImageFolder
    from .imageobserver import ImageObserver
    from .observation import Observations
    from .renderedfolder import render_folder
    from .report.comparison import write_report
    from .rig.rig import RigGeometry
    from .scene import Scene, load_scene, shipped_scenes
    from .scenespec import SceneSpec

_HOMES = {
    "AnalyticObserver": "analytic.observer",
    "BackendError": "errors",
    "Comparison": "comparison",
    "Extractor": "benchmark.protocol",
    "EyeModel": "eye.model",
    "EyeSpec": "eye.spec",
    "EyerenderError": "errors",
    "ImageFolder": "imagefolder",
    "ImageObserver": "imageobserver",
    "InputError": "errors",
    "Observations": "observation",
    "RigGeometry": "rig.rig",
    "Scene": "scene",
    "SceneSpec": "scenespec",
    "compare": "comparison",
    "load_eye": "eye.catalogue",
    "load_scene": "scene",
    "render_folder": "renderedfolder",
    "render_windows": "capture",
    "shipped_scenes": "scene",
    "write_report": "report.comparison",
}

__all__ = [
    "AnalyticObserver",
    "BackendError",
    "Comparison",
    "Extractor",
    "EyeModel",
    "EyeSpec",
    "EyerenderError",
    "ImageFolder",
    "ImageObserver",
    "InputError",
    "Observations",
    "RigGeometry",
    "Scene",
    "SceneSpec",
    "__version__",
    "compare",
    "gaze",
    "load_eye",
    "load_scene",
    "render_folder",
    "render_windows",
    "shipped_scenes",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("eyerender")
    if name == "gaze":
        return import_module(".gaze", __name__)
    if name in _HOMES:
        return getattr(import_module(f".{_HOMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
