"""What a problem does not determine: its null space, the motions in it, and the sentences that name them."""
