from .biometry import BiometrySpec as BiometrySpec
from .contact import ContactLens as ContactLens
from .kappa import kappa_deg as kappa_deg
from .kappa import with_kappa as with_kappa
from .margin import PupilMargin as PupilMargin
from .model import EyeModel as EyeModel
from .parts import TopographySpec as TopographySpec
from .topography import read_topography as read_topography

__all__: list[str]
