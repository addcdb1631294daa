from .synteyes import SyntEye as SyntEye
from .synteyes import SyntEyes as SyntEyes

__all__: list[str]
