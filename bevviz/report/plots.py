"""Line plots as SVG, to be put into a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

Series = Sequence[tuple[float, float]]  # x, y

WIDTH, HEIGHT = 560, 190
LEFT, RIGHT, TOP, BOTTOM = 52, 18, 10, 24
COLORS = 10  # of style sheet classes s0, s1 ...


def plot(title: str, series: Mapping[str, Series], at: float) -> str:
    """A figure with one line for each series over seconds, its legend, and a mark at the time ``at``."""
    shown = {name: points for name, points in series.items() if points}
    if not shown:
        return ""
    x = np.array([p[0] for points in shown.values() for p in points])
    y = np.array([p[1] for points in shown.values() for p in points])
    bottom, top = min(y.min(), 0.0), max(y.max(), 0.0)
    x_ticks, y_ticks = ticks(x.min(), x.max(), 6), ticks(bottom, top if top > bottom else 1.0, 4)
    left, right = min(x.min(), at), max(x.max(), at, x.min() + 1e-9)
    low, high = y_ticks[0], y_ticks[-1]

    def column(value: float) -> str:
        return f"{LEFT + (value - left) / (right - left) * (WIDTH - LEFT - RIGHT):.1f}"

    def row(value: float) -> str:
        return f"{HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM):.1f}"

    parts = []
    for tick in y_ticks:
        at_row = row(tick)
        parts.append(f'<path class="grid" d="M{LEFT} {at_row}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text class="y" x="{LEFT - 6}" y="{at_row}">{tick:g}</text>')
    parts += [
        f'<text class="x" x="{column(tick)}" y="{HEIGHT - 6}">{tick:g} s</text>'
        for tick in x_ticks
        if left <= tick <= right
    ]
    parts.append(f'<path class="at" d="M{column(at)} {TOP}V{HEIGHT - BOTTOM}"/>')
    legend = []
    for number, (name, points) in enumerate(shown.items()):
        line = " ".join(f"{column(a)},{row(b)}" for a, b in points)
        look, label = f"s{number % COLORS}", escape(name)
        parts.append(f'<polyline class="{look}" points="{line}"><title>{label}</title></polyline>')
        if len(points) == 1:
            parts.append(
                f'<circle class="{look}" cx="{line.split(",")[0]}" cy="{line.split(",")[1]}" r="3"/>'
            )
        legend.append(f'<span><i class="{look}"></i>{label}</span>')
    return (
        f'<figure class="plot"><figcaption>{escape(title)}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">{"".join(parts)}</svg>'
        f'<p class="legend">{"".join(legend)}</p></figure>'
    )


def ticks(low: float, high: float, count: int) -> list[float]:
    """About ``count`` round numbers that enclose ``low`` to ``high``, at least two.

    >>> ticks(0, 9.3, 4)
    [0.0, 2.5, 5.0, 7.5, 10.0]
    """
    span = max(float(high - low), abs(float(high)) * 1e-9, 1e-9)
    power = 10.0 ** np.floor(np.log10(span / count))
    step = float(power * next(m for m in (1, 2, 2.5, 5, 10, 20) if m * power * count >= span * 0.999))
    first, last = int(np.floor(low / step + 1e-9)), int(np.ceil(high / step - 1e-9))
    return [round(n * step, 12) for n in range(first, max(last, first + 1) + 1)]
