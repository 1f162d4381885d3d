"""Interactive figures of any optimisation: errors before and after, and how the cost fell."""

from __future__ import annotations

import math

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from boxplus.report.palette import FAINT, GRID, INK, SERIES
from boxplus.runs.optimization_summary import IterationFacts

FONT = {"family": "system-ui, -apple-system, 'Segoe UI', sans-serif", "size": 12, "color": INK}
BEFORE, AFTER = FAINT, SERIES[0]
_BINS = 80
_SMALLEST = 1e-12


def error_bins(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Edges of logarithmic bins over the errors; the smallest, which would stretch the axis without end, fall into the first."""
    both = np.concatenate([before[np.isfinite(before)], after[np.isfinite(after)]])
    both = both[both > _SMALLEST]
    if not len(both):
        return np.geomspace(1e-3, 1.0, _BINS + 1)
    high = float(both.max())
    low = max(float(np.percentile(both, 0.1)), 1e-3 * float(np.median(both)), 1e-5 * high)
    return np.geomspace(low, max(high, 1.001 * low) * 1.000001, _BINS + 1)


def counts_per_bin(errors: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.int64]:
    """How many finite errors fall into each bin; those below the first are counted in it."""
    valid = errors[np.isfinite(errors)]
    return np.histogram(np.clip(valid, edges[0], None), edges)[0]


def error_histogram(before: NDArray[np.float64], after: NDArray[np.float64], unit: str) -> go.Figure:
    """How often which error occurs, before and after, both axes logarithmic."""
    figure = go.Figure()
    edges = error_bins(before, after)
    middle = np.sqrt(edges[1:] * edges[:-1])
    for name, errors, color in (("before", before, BEFORE), ("after", after, AFTER)):
        counts = counts_per_bin(errors, edges)
        figure.add_scatter(
            x=middle,
            y=np.where(counts > 0, counts, np.nan),
            name=name,
            mode="lines",
            connectgaps=False,
            line={"color": color, "width": 2, "shape": "hvh", "dash": "dot" if name == "before" else "solid"},
            hovertemplate=f"{name}: %{{y}} around %{{x:.3g}} {unit}<extra></extra>",
        )
        valid = errors[np.isfinite(errors)]
        if len(valid):
            figure.add_vline(x=float(np.median(valid)), line={"color": color, "width": 1, "dash": "dot"})
    figure.update_xaxes(title_text=f"error [{unit}] (dotted: median)", type="log", exponentformat="power")
    figure.update_yaxes(title_text="how many", type="log", dtick=1, exponentformat="power")
    return styled(figure, 300)


def cost_over_iterations(history: list[IterationFacts], parameter: str) -> go.Figure:
    """Cost, gradient and what the method regulates, over the steps tried."""
    figure = make_subplots(rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=[0.5, 0.25, 0.25])
    number = [i.number for i in history]
    rejected = [i for i in history if not i.accepted and i.tried_cost is not None]
    line = {"color": SERIES[0], "width": 2}
    hover = "%{x}: %{y:.6e}<extra></extra>"
    figure.add_scatter(
        x=number, y=[i.cost for i in history], name="cost", mode="lines+markers", line=line, hovertemplate=hover, row=1, col=1
    )
    costs = [i.cost for i in history if i.cost > 0.0] or [1.0]
    top = max(costs) * (max(costs) / min(costs)) ** 0.1  # steps that led further up are drawn at the upper edge
    if rejected:
        figure.add_scatter(
            x=[i.number for i in rejected],
            y=[min(i.tried_cost or top, top) for i in rejected],
            customdata=[i.tried_cost for i in rejected],
            name="tried and rejected",
            mode="markers",
            marker={"symbol": "x", "color": SERIES[4], "size": 7},
            hovertemplate="%{x}: %{customdata:.6e}<extra></extra>",
            row=1,
            col=1,
        )
    for row, (name, values, color) in enumerate(
        (("gradient", [i.gradient for i in history], SERIES[2]), (parameter, [i.parameter for i in history], SERIES[3])), 2
    ):
        shown = [value if value > 0.0 else None for value in values]
        line = {"color": color, "width": 1.5}
        figure.add_scatter(x=number, y=shown, name=name, mode="lines+markers", marker={"size": 4}, line=line, row=row, col=1)
        figure.update_yaxes(title_text=name, row=row, col=1)
    for row, values in enumerate(([*costs, top], [i.gradient for i in history], [i.parameter for i in history]), 1):
        figure.update_yaxes(type="log", exponentformat="power", dtick=_decades_between_ticks(values), row=row, col=1)
    figure.update_yaxes(title_text="cost", row=1, col=1)
    figure.update_xaxes(dtick=max(1, len(history) // 10))
    figure.update_xaxes(title_text="step", row=3, col=1)
    return styled(figure, 460)


def _decades_between_ticks(values: list[float]) -> int | None:
    """So many that a low panel has room for their labels; None, to let the page choose, for less than a decade."""
    positive = [value for value in values if value > 0.0]
    decades = math.log10(max(positive) / min(positive)) if positive else 0.0
    return math.ceil(decades / 4.0) if decades > 1.0 else None


def styled(figure: go.Figure, height: int) -> go.Figure:
    """The look of all plane figures."""
    figure.update_layout(
        height=height,
        font=FONT,
        paper_bgcolor="white",
        plot_bgcolor="white",
        margin={"l": 80, "r": 20, "t": 30, "b": 44},
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "itemsizing": "constant"},
    )
    figure.update_xaxes(showgrid=True, gridcolor=GRID, zeroline=False)
    figure.update_yaxes(showgrid=True, gridcolor=GRID, zeroline=False)
    return figure
