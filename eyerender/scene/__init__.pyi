from .scene import Frame as Frame
from .scene import Frames as Frames
from .scene import Scene as Scene
from .shipped import is_dataset as is_dataset
from .shipped import is_shipped_dataset as is_shipped_dataset
from .shipped import load_scene as load_scene
from .shipped import refuse_folder as refuse_folder
from .shipped import shipped_files as shipped_files
from .shipped import shipped_scenes as shipped_scenes

__all__: list[str]
