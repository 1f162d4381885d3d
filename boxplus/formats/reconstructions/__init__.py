"""Cameras and what they saw: BAL, GBP, COLMAP, and the line sets of the Visual Geometry Group."""
