"""Nonlinear least squares: problems, their solvers, elimination and covariance."""
