"""Orders of elimination: minimum degree, nested dissection, and what a factorisation in an order costs."""
