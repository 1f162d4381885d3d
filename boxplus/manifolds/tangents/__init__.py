"""How points move with a tangent: from one ⊞ to another, by a small step, and what automatic differentiation begins with."""
