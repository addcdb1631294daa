from .camera import CalibrationFile as CalibrationFile
from .camera import CameraCalibration as CameraCalibration
from .camera import Mirror as Mirror
from .camera import PinholeCamera as PinholeCamera
from .exposure import electrons as electrons
from .exposure import expose as expose
from .imaging import Ambient as Ambient
from .imaging import Lens as Lens
from .imaging import Motion as Motion
from .imaging import Opening as Opening
from .imaging import Panel as Panel
from .imaging import RadianceMap as RadianceMap
from .imaging import Star as Star
from .imaging import Sun as Sun
from .light import Lamp as Lamp
from .light import LedRing as LedRing
from .obstacles import Obstacle as Obstacle
from .obstacles import ObstacleRing as ObstacleRing
from .opencv import OpenCvCalibration as OpenCvCalibration
from .opencv import read_opencv as read_opencv
from .rig import RigGeometry as RigGeometry
from .rig import RigLike as RigLike
from .screen import ScreenPlane as ScreenPlane
from .surroundings import paint as paint
from .unit import UnitCalibration as UnitCalibration
from .unit import write_unit as write_unit

__all__: list[str]
