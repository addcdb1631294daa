from .choice import SiteInformation as SiteInformation
from .choice import choose_lights as choose_lights
from .choice import noise_of_some as noise_of_some
from .choice import site_information as site_information
from .fit import EyeFit as EyeFit
from .information import Information as Information
from .noise import FeatureNoise as FeatureNoise
from .noise import extracted_noise as extracted_noise
from .safety import Exposure as Exposure
from .safety import eye_exposure as eye_exposure
from .tolerances import Tolerances as Tolerances

__all__: list[str]
