"""Plots as SVG, written by hand: grouped bars, and lines over logarithmic axes. No package, no script, light and dark alike."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

COLOURS = ("#c8641e", "#2b7fb8", "#5a9a3c", "#8f5bb0", "#b08a1e", "#6b7280", "#c23b5e", "#2aa198")
INK, LINE = "#7c808a", "#c9ccd3"
WIDTH, HEIGHT = 760, 380
LEFT, RIGHT, TOP, BOTTOM = 64, 180, 34, 46


def bars(title: str, groups: Sequence[str], series: Mapping[str, Sequence[float | None]], top: float = 1.0) -> str:
    """An SVG of grouped bars from 0 to `top`: a group a name, a bar a series; a value of None leaves a gap."""
    parts = _frame(title)
    inner = WIDTH - LEFT - RIGHT
    for step in range(6):
        value = top * step / 5
        parts += _level(_y(value / top), f"{value:.2g}")
    slot = inner / max(len(groups), 1)
    wide = 0.8 * slot / max(len(series), 1)
    for g, group in enumerate(groups):
        parts.append(_text(LEFT + (g + 0.5) * slot, HEIGHT - BOTTOM + 20, group, "middle"))
        for s, values in enumerate(series.values()):
            value = values[g]
            if value is None:
                continue
            y = _y(min(value / top, 1.0))
            x = LEFT + g * slot + 0.1 * slot + s * wide
            parts.append(
                f'<rect x="{x:.1f}" y="{y:.1f}" width="{0.92 * wide:.1f}" height="{_y(0.0) - y:.1f}" '
                f'fill="{COLOURS[s % len(COLOURS)]}"><title>{html.escape(group)}: {value:.3f}</title></rect>'
            )
    return _closed(parts, list(series))


def lines(title: str, across: str, up: str, series: Mapping[str, Sequence[tuple[float, float]]]) -> str:
    """An SVG of lines through (x, y) points, both axes logarithmic; points that aren't above 0 are left out."""
    kept = {name: [(x, y) for x, y in points if x > 0 and y > 0] for name, points in series.items()}
    every = [point for points in kept.values() for point in points] or [(1.0, 1.0)]
    (x_low, x_high), (y_low, y_high) = (_decades([point[axis] for point in every]) for axis in (0, 1))
    parts = _frame(title)
    for power in range(y_low, y_high + 1):
        parts += _level(_y((power - y_low) / (y_high - y_low)), _power(power))
    for power in range(x_low, x_high + 1):
        x = LEFT + (WIDTH - LEFT - RIGHT) * (power - x_low) / (x_high - x_low)
        parts.append(f'<line x1="{x:.1f}" y1="{TOP}" x2="{x:.1f}" y2="{HEIGHT - BOTTOM}" stroke="{LINE}" stroke-width="0.5"/>')
        parts.append(_text(x, HEIGHT - BOTTOM + 18, _power(power), "middle"))
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, across, "middle"))
    parts.append(_text(8, TOP - 12, up, "start"))
    for s, points in enumerate(kept.values()):
        colour = COLOURS[s % len(COLOURS)]
        places = [
            (
                LEFT + (WIDTH - LEFT - RIGHT) * (math.log10(x) - x_low) / (x_high - x_low),
                _y((math.log10(y) - y_low) / (y_high - y_low)),
            )
            for x, y in sorted(points)
        ]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in places]
    return _closed(parts, list(kept))


def _decades(values: Sequence[float]) -> tuple[int, int]:
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    return low, max(high, low + 1)


def _power(power: int) -> str:
    return f"{10.0**power:g}" if -3 <= power <= 4 else f"1e{power}"


def _y(share: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * share


def _frame(title: str) -> list[str]:
    return [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        f'font-family="sans-serif" font-size="12" fill="{INK}">',
        f'<text x="{LEFT}" y="16" font-size="14" font-weight="bold">{html.escape(title)}</text>',
    ]


def _level(y: float, name: str) -> list[str]:
    line = f'<line x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - RIGHT}" y2="{y:.1f}" stroke="{LINE}" stroke-width="0.5"/>'
    return [line, _text(LEFT - 6, y + 4, name, "end")]


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(text)}</text>'


def _closed(parts: list[str], names: Sequence[str]) -> str:
    for n, name in enumerate(names):
        y = TOP + 18 * n
        parts.append(f'<rect x="{WIDTH - RIGHT + 14}" y="{y}" width="11" height="11" fill="{COLOURS[n % len(COLOURS)]}"/>')
        parts.append(_text(WIDTH - RIGHT + 31, y + 10, name, "start"))
    return "\n".join([*parts, "</svg>"]) + "\n"
