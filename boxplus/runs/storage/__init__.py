"""What lies on disk: folders and their locks, tables that grow, states of objects."""
