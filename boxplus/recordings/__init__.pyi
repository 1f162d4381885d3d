from .info import Evidence as Evidence
from .info import PointTimeReading as PointTimeReading
from .info import RecordingInfo as RecordingInfo
from .info import Topic as Topic
from .open import open_recording as open_recording
from .options import RecordingOptions as RecordingOptions
from .recording import Event as Event
from .recording import Recording as Recording
