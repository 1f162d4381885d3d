"""What all reports share: one self-contained page with its style, sections, tiles and tables."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from string import Template

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from boxplus.formats.output import atomic_file

_STYLE = """
:root { --ink: #22303c; --faint: #6b7a8f; --line: #e4e8ec; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f7f9; color: var(--ink); font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 24px; margin: 0; } h2 { font-size: 17px; margin: 0 0 2px; }
.lead { color: var(--faint); margin: 4px 0 18px; }
section { background: white; border: 1px solid var(--line); border-radius: 8px; padding: 16px 18px; margin: 16px 0; }
section > p { color: var(--faint); margin: 0 0 8px; font-size: 14px; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(160px, 1fr)); gap: 12px; margin: 18px 0 0; }
.figures div { background: white; border: 1px solid var(--line); border-radius: 8px; padding: 12px 14px; }
.figures b { display: block; font-size: 21px; font-weight: 600; } .figures span { color: var(--faint); font-size: 13px; }
.state { display: inline-block; border-radius: 5px; padding: 1px 9px; color: white; background: #2f7d5b; font-size: 14px; }
.state.interrupted, .state.running { background: #b97a1a; } .state.failed { background: #c1443c; }
.warnings { border-left: 4px solid #e09f3e; } .warnings ul { margin: 6px 0 0; padding-left: 20px; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
td, th { text-align: left; vertical-align: top; padding: 4px 12px 4px 0; border-bottom: 1px solid var(--line); }
th { color: var(--faint); font-weight: 500; } td.key { color: var(--faint); white-space: nowrap; width: 1%; padding-right: 24px; }
td.warning { color: #a8690c; } td.error { color: #c1443c; }
code, pre { font: 13px ui-monospace, Menlo, Consolas, monospace; } pre { margin: 0; }
details { margin-top: 8px; } summary { cursor: pointer; color: var(--faint); }
@media print { body { background: white; } section { break-inside: avoid; } }
"""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>$style</style>
<script>$plotly</script>
</head>
<body>
<main>
$body
</main>
</body>
</html>
""")

_CONFIG = {"displaylogo": False, "responsive": True, "displayModeBar": False}
_CONFIG_3D = {"displaylogo": False, "responsive": True, "displayModeBar": True, "scrollZoom": True}


def write_html(path: Path, title: str, body: str) -> Path:
    """Write a page that needs nothing from elsewhere; returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    text = _PAGE.substitute(title=f"{escape(title)} – boxplus", style=_STYLE, plotly=get_plotlyjs(), body=body)
    with atomic_file(path) as file:
        file.write(text.encode())
    return path


def tiles(numbers: Iterable[tuple[str, str]]) -> str:
    """The row of large numbers: value and what it is."""
    drawn = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for value, name in numbers)
    return f'<div class="figures">{drawn}</div>'


def warnings_section(lines: Iterable[str]) -> str:
    """The warnings, items of HTML; or that there are none."""
    items = "".join(f"<li>{line}</li>" for line in lines)
    if not items:
        return '<section><h2>Warnings</h2><p style="margin:0">None.</p></section>'
    return f'<section class="warnings"><h2>Warnings</h2><ul>{items}</ul></section>'


def figure_section(title: str, text: str, figure: go.Figure, below: str = "") -> str:
    """A section with an interactive figure, and HTML below it."""
    is_3d = any(trace.type.endswith("3d") for trace in figure.data)
    drawn = figure.to_html(full_html=False, include_plotlyjs=False, config=_CONFIG_3D if is_3d else _CONFIG, default_width="100%")
    return f"<section><h2>{escape(title)}</h2><p>{escape(text)}</p>{drawn}{below}</section>"


def html_table(rows: Iterable[tuple[str, ...]], heading: tuple[str, ...] = ()) -> str:
    """A table; the first cell of a row is its key."""
    head = f"<tr>{''.join(f'<th>{escape(cell)}</th>' for cell in heading)}</tr>" if heading else ""
    body = "".join(
        f'<tr><td class="key">{escape(row[0])}</td>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>' for row in rows
    )
    return f"<table>{head}{body}</table>" if body else ""
