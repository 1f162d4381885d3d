"""Sparse least squares: block-sparse matrices, orderings and the Cholesky factorisation."""
