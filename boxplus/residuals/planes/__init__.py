"""Planes that many scans see: clusters of points that cost the same however many points they hold."""
