from .options import RunOptions as RunOptions
from .ownscenes import GivenScene as GivenScene
from .plan import Plan as Plan
from .plan import Sample as Sample
from .realise import Realised as Realised
from .realise import Rejection as Rejection
from .realise import sample as sample
from .run import generate as generate
from .sheet import preview as preview
from .spec import DatasetSpec as DatasetSpec
from .spec import LabelsSpec as LabelsSpec
from .spec import find_dataset as find_dataset
from .spec import shipped_datasets as shipped_datasets
from .writer import DatasetWriter as DatasetWriter

__all__: list[str]
