"""The recorder: every decision with its input in MCAP files, and the last half minute before an incident.

What is named here is what a service needs; files are read by `recorder.reading`.
"""

from recorder.errors import RecordingError
from recorder.recorder import Recorder, Settings

__all__ = ["Recorder", "RecordingError", "Settings"]
