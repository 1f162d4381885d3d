"""What changes from scan to scan, and the motion that explains it, or the rest."""
