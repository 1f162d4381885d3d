"""Pose graphs: g2o and TORO."""
