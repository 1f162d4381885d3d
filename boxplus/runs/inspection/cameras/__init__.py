"""The data doctor for cameras: streams, brightness, stereo, and whether cameras and IMU turn alike."""
