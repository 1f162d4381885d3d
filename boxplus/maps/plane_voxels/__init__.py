"""Planes of a whole recording, found in voxels that are split where they hold more than one."""
