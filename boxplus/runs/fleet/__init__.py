"""`boxplus fleet run`: many recordings, each a run of its own, and one map of those that met."""
