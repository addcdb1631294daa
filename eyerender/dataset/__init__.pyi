from .options import RunOptions as RunOptions
from .ownscenes import GivenScene as GivenScene
from .plan import Plan as Plan
from .plan import Sample as Sample
from .realise import Realised as Realised
from .realise import Rejection as Rejection
from .spec import LabelsSpec as LabelsSpec
from .spec import find_dataset as find_dataset
from .spec import shipped_datasets as shipped_datasets

__all__: list[str]
