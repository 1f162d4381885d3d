"""What the docstrings of boxplus have that the reader of docstrings (griffe) and Markdown would take for something else.

The sources stay as people read them in an editor. For the site
- `Example:` is a section of code with its output, as `Examples:` is for griffe;
- `fx, fy: focal lengths [px]` describes two attributes in one line: griffe would take the second for a type;
- `[w, v] [rad, m]` is a vector with its units: Markdown would take it for a link.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

SEVERAL = re.compile(r"^(\s+)(\w+(?:, \w+)+)(?=[:(])", re.MULTILINE)
BRACKETS = re.compile(r"\]( ?)\[")


class Docstrings(Extension):
    """Rewrites docstrings before they are parsed."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring is None:
            return
        text = re.sub(r"^(\s*)Example:\n", r"\1Examples:\n", obj.docstring.value, flags=re.MULTILINE)
        text = SEVERAL.sub(lambda match: match[1] + match[2].replace(", ", ",\N{NO-BREAK SPACE}"), text)
        prose, examples, code = text.partition("Examples:\n")
        spans = re.split(r"(`[^`]*`)", prose)  # every second one is code
        spans[::2] = [BRACKETS.sub(r"]\1\\[", span) for span in spans[::2]]
        obj.docstring.value = "".join(spans) + examples + code
