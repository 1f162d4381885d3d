"""A map laid onto the Earth by positions of a satellite receiver. Derivation: docs/gnss.md."""
