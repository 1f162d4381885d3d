"""Sparse factorisation: matrices of dense blocks, orderings, the supernodal Cholesky factor, solves and blocks of the inverse."""
