"""Error terms for `Problem.add_residuals`: one kind a file, each a group of N residuals with analytic Jacobians."""
