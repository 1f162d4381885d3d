"""`python -m boxplus`: the command `boxplus`, where it is not on the path."""

from __future__ import annotations

from boxplus.cli import main

if __name__ == "__main__":
    main()
