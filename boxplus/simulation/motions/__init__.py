"""How a simulated body moves: splines with exact derivatives, and the motions made of them."""
