"""Gauss-Newton, Levenberg-Marquardt and the dogleg, and the loop that they share."""
