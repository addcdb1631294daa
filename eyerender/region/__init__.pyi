from .anatomy import Brow as Brow
from .anatomy import Face as Face
from .anatomy import Fissure as Fissure
from .anatomy import Lashes as Lashes
from .anatomy import Lid as Lid
from .anatomy import Skin as Skin
from .anatomy import TearFilm as TearFilm
from .headspec import Head as Head
from .headspec import HeadParts as HeadParts
from .look import Fundus as Fundus
from .look import IrisPattern as IrisPattern
from .look import Scattering as Scattering
from .mesh import LidMargins as LidMargins
from .mesh import RegionMesh as RegionMesh
from .mesh import lid_margins as lid_margins
from .mesh import region_mesh as region_mesh

__all__: list[str]
