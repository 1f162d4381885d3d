"""Depths of a keyframe: measured by a sensor, found in a second camera, or by the motion."""
