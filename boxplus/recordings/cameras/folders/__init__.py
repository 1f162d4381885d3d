"""Recordings of cameras as folders with one file for each image: EuRoC, TUM RGB-D, KITTI, 7-Scenes."""
