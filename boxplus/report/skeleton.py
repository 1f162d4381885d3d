"""What all reports share: one self-contained page with its style, sections, tiles and tables."""

from __future__ import annotations

import base64
import functools
import gzip
import io
import json
from collections.abc import Iterable
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from boxplus.formats.output import atomic_file

_STYLE = """
:root { color-scheme: light dark; --ink: #22303c; --faint: #5d6c80; --line: #e4e8ec; --page: #f5f7f9; --card: #ffffff;
  --ok: #1d6fa8; --doubt: #8a5a00; --bad: #a03070; }
@media (prefers-color-scheme: dark) { :root { --ink: #dfe6ec; --faint: #93a1b3; --line: #36404a; --page: #14191e; --card: #1d242b;
  --doubt: #dd9000; --bad: #e58fbe; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 24px; margin: 0; overflow-wrap: anywhere; } h2 { font-size: 17px; margin: 0 0 2px; }
a { color: var(--ok); } @media (prefers-color-scheme: dark) { a { color: #6fbcec; } }
.lead { color: var(--faint); margin: 4px 0 18px; overflow-wrap: anywhere; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 16px 18px; margin: 16px 0; }
section > p { color: var(--faint); margin: 0 0 8px; font-size: 14px; overflow-wrap: anywhere; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(160px, 1fr)); gap: 12px; margin: 18px 0 0; }
.figures div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 12px 14px; }
.figures b { display: block; font-size: 21px; font-weight: 600; } .figures span { color: var(--faint); font-size: 13px; }
.state { display: inline-block; border-radius: 5px; padding: 1px 9px; color: white; background: #1d6fa8; font-size: 14px; }
.state.interrupted, .state.running { background: #8a5a00; } .state.failed { background: #a03070; }
.warnings { border-left: 4px solid #dd9000; } .warnings ul { margin: 6px 0 0; padding-left: 20px; overflow-wrap: anywhere; }
.table { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: 14px; }
td, th { text-align: left; vertical-align: top; padding: 4px 12px 4px 0; border-bottom: 1px solid var(--line); }
th { color: var(--faint); font-weight: 500; } td.key { color: var(--faint); white-space: nowrap; width: 1%; padding-right: 24px; }
td.warning { color: var(--doubt); } td.error { color: var(--bad); font-weight: 600; }
code, pre { font: 13px ui-monospace, Menlo, Consolas, monospace; } pre { margin: 0; overflow-x: auto; }
img { max-width: 100%; height: auto; background: white; border-radius: 4px; }
details { margin-top: 8px; } summary { cursor: pointer; color: var(--faint); }
@media (max-width: 640px) {
  main { padding: 14px 10px 40px; } section { padding: 12px 10px; margin: 12px 0; }
  .figures { grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 8px; }
  .figures div { padding: 9px 10px; overflow-wrap: anywhere; } table { display: block; overflow-x: auto; }
  .figures b { font-size: 18px; } td.key { white-space: normal; width: auto; padding-right: 12px; }
  td { min-width: 64px; overflow-wrap: break-word; } td.key + td:last-child { overflow-wrap: anywhere; }
  td:nth-child(n + 5):last-child { min-width: 220px; }
  table.evidence tr { display: grid; grid-template-columns: 1fr 1fr auto; padding: 4px 0; border-bottom: 1px solid var(--line); }
  table.evidence td { border: 0; padding: 0 12px 0 0; overflow-wrap: anywhere; }
  table.evidence td:last-child { grid-column: 1 / -1; } table.evidence th { display: none; }
}
@media print { body { background: white; } section { break-inside: avoid; } }
"""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>$style</style>
</head>
<body>
<main>
$body
</main>
$scripts
</body>
</html>
""")
_SCRIPTS = Template("""<script id="plotly" type="text/plain">$library</script>
<script>$code</script>""")

_CONFIG = {"displaylogo": False, "responsive": True, "displayModeBar": False}
_DPI = 110
_CONFIG_3D = {"displaylogo": False, "responsive": True, "displayModeBar": True, "scrollZoom": True}


def write_html(path: Path, title: str, body: str) -> Path:
    """Write a page that needs nothing from elsewhere; returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    scripts = ""
    if 'class="plot"' in body:
        code = resources.files("boxplus.report").joinpath("page.js").read_text(encoding="utf-8")
        scripts = _SCRIPTS.substitute(library=_packed_library(), code=code)
    text = _PAGE.substitute(title=f"{escape(title)} – boxplus", style=_STYLE, body=body, scripts=scripts)
    with atomic_file(path) as file:
        file.write(text.encode())
    return path


def packed(text: str) -> str:
    """Compressed text in letters that need no escaping in HTML: a third of what the figures take as they are."""
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()


@functools.cache
def _packed_library() -> str:
    return packed(get_plotlyjs())


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
    drawn = json.loads(figure.to_json())
    drawn["config"] = _CONFIG_3D if is_3d else _CONFIG
    drawn["data"] = [_in_short(trace) for trace in drawn["data"]]
    height = figure.layout.height or 450
    place = f'<div class="plot" style="height:{height}px"><script type="text/plain">{packed(json.dumps(drawn))}</script></div>'
    return f"<section><h2>{escape(title)}</h2><p>{escape(text)}</p>{place}{below}</section>"


def _in_short(value: Any) -> Any:
    """Arrays of numbers to five digits, which no eye tells from sixteen: zeros at their ends compress well."""
    if isinstance(value, list):
        return [_in_short(part) for part in value]
    if not isinstance(value, dict):
        return value
    if value.get("dtype") == "f8":
        numbers = np.frombuffer(base64.b64decode(value["bdata"]), "<f8").astype("<f4")
        whole = np.isfinite(numbers)
        bits = np.where(whole, numbers.view("<u4") + np.uint32(0x40) & np.uint32(0xFFFFFF80), numbers.view("<u4"))
        return {**value, "dtype": "f4", "bdata": base64.b64encode(bits.astype("<u4").tobytes()).decode()}
    return {key: _in_short(part) for key, part in value.items()}


def picture(figure: Figure, name: str) -> str:
    """A drawing as an image within the page, in few colours: a quarter of what all of them take."""
    from PIL import Image

    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI)
    Image.open(drawn).convert("RGB").quantize(64, method=Image.Quantize.MAXCOVERAGE).save(small, format="png", optimize=True)
    encoded = base64.b64encode(small.getvalue()).decode()
    return f'<img alt="{escape(name)}" src="data:image/png;base64,{encoded}">'


def html_table(rows: Iterable[tuple[str, ...]], heading: tuple[str, ...] = ()) -> str:
    """A table; the first cell of a row is its key."""
    head = f"<tr>{''.join(f'<th>{escape(cell)}</th>' for cell in heading)}</tr>" if heading else ""
    body = "".join(
        f'<tr><td class="key">{escape(row[0])}</td>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>' for row in rows
    )
    return f'<div class="table"><table>{head}{body}</table></div>' if body else ""
