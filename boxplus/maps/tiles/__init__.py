"""The map on disk: points streamed to tiles through a journal, read again, merged to one file."""
