"""`boxplus lio` over files: its settings, its mounting, what it counts and writes."""
