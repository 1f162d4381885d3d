"""Readers that turn a bag, an MCAP file, a pcap or a folder into scans and IMU samples, streaming."""

from boxplus.recordings.info import Evidence, PointTimeReading, RecordingInfo, Topic
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.recording import Event, Recording, open_recording

__all__ = ["Event", "Evidence", "PointTimeReading", "Recording", "RecordingInfo", "RecordingOptions", "Topic", "open_recording"]
