"""Writes docs/settings.md, the manual's table of all parameters, from `ct2hair_addon/settings.py`; `make manual` runs it."""

import sys
from dataclasses import fields
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ct2hair_addon.settings import PRESETS, Settings, SimulationSettings  # noqa: E402

PAGE = ROOT / "docs" / "settings.md"


def table() -> str:
    """The page as Markdown."""
    lines = [
        "# All parameters",
        "",
        "Made by `make manual` from `ct2hair_addon/settings.py`; a test keeps it current. On the command line a parameter is",
        '`--stage-name`, in JSON `{"stage": {"name": value}}`, in the panel it is under *All Parameters*.',
    ]
    groups = [(stage.name, type(stage.default)) for stage in fields(Settings)] + [("simulation", SimulationSettings)]
    for name, group in groups:
        lines += ["", f"## {name}", "", group.__doc__.strip(), "", "| name | default | range | unit | what it does |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        for known in fields(group):
            meta = known.metadata
            low, high = meta["low"], meta["high"]
            range_ = ", ".join(meta["choices"]) or (f"{low:g} to {high:g}" if low is not None and high is not None else "")
            default = f"`{known.default}`" if known.default != "" else "empty"
            lines.append(f"| `{known.name}` | {default} | {range_} | {meta['unit']} | {meta['help'].replace('|', '/')} |")
    lines += ["", "## Presets", "", "What each preset changes of the defaults.", "", "| preset | changes |", "| --- | --- |"]
    for name, changes in PRESETS.items():
        lines.append(f"| {name} | {', '.join(f'`{key}` {value}' for key, value in changes.items()) or 'nothing'} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(table(), encoding="utf-8")
    print(PAGE)
