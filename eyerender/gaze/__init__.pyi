from .columns import CsvColumns as CsvColumns
from .crossratio import CrossRatio as CrossRatio
from .estimate import GazeEstimator as GazeEstimator
from .estimate import GazePoints as GazePoints
from .estimate import GazeRays as GazeRays
from .estimate import StoredEstimator as StoredEstimator
from .estimate import angular_error_deg as angular_error_deg
from .estimate import binocular_average as binocular_average
from .guestrin import GuestrinEizenman as GuestrinEizenman
from .hennessey import Hennessey as Hennessey
from .homography import Homography as Homography
from .parameters import EyeParameters as EyeParameters
from .parameters import ParameterBounds as ParameterBounds
from .recalibration import Recalibration as Recalibration
from .records import load_observations as load_observations
from .records import load_rig as load_rig
from .regression import Regression as Regression
from .store import load_estimator as load_estimator
from .store import save_estimator as save_estimator
from .table import observations_from_csv as observations_from_csv
from .twocamera import ShihWuLiu as ShihWuLiu
from .validation import GazeErrors as GazeErrors
from .validation import gaze_errors as gaze_errors
from .validation import leave_one_target_out as leave_one_target_out

__all__: list[str]
