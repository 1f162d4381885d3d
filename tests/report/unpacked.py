"""The figures of a page, which lie in it compressed."""

from __future__ import annotations

import base64
import gzip
import re


def figures_of(page: str) -> list[str]:
    """Each as the JSON that the page's code hands to Plotly."""
    packed = re.findall(r'<div class="plot"[^>]*><script type="text/plain">([^<]*)</script></div>', page)
    return [gzip.decompress(base64.b64decode(text)).decode() for text in packed]
