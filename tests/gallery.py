"""The gallery of the hairstyles: docs/hairstyles/STYLE.png by Cycles, and docs/hairstyles.md with what each measures.

    .venv/bin/python tests/gallery.py [STYLE ...] [--strands N] [--size PIXELS] [--samples N]

Pictures of the styles named (all by default) are made anew; the page is written for all styles that have a picture.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
OUT = ROOT / "docs" / "hairstyles"
VIEWS = ("three_quarter", "back")
SEED = 7
CURLED = ("curly", "jewfro", "jheri_curl")
"""Styles of tight coils: their radius is measured as well."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("styles", nargs="*", help="the styles to picture (default: all)")
    parser.add_argument("--strands", type=int, default=20000, help="of each style (default: %(default)s)")
    parser.add_argument("--size", type=int, default=260, help="pixels of a view (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=6, help="of Cycles (default: %(default)s)")
    parser.add_argument("--page", action="store_true", help="write the page alone")
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)

    from ct2hair_addon.evaluation import STYLES

    unknown = set(options.styles) - set(STYLES)
    if unknown:
        parser.error(f"there is no style {', '.join(sorted(unknown))}; there are {', '.join(STYLES)}")
    if not options.page:
        for name in options.styles or STYLES:
            render(name, options)
            print("gallery:", OUT / f"{name}.png", flush=True)
    (OUT.parent / "hairstyles.md").write_text(page(options.strands))
    return 0


def render(name: str, options: argparse.Namespace) -> None:
    """The views of a style side by side, in one small PNG."""
    import bpy
    import numpy as np
    from PIL import Image

    from ct2hair_addon import scene
    from ct2hair_addon.evaluation import hairstyle
    from ct2hair_addon.head import template_head

    bpy.ops.wm.read_factory_settings(use_empty=True)
    head = template_head()
    result = scene.show_strands(hairstyle(name, head, options.strands, SEED), head, name)
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for view in VIEWS:
            path = Path(folder) / f"{view}.png"
            with scene.quiet():
                scene.render_picture(result, path, view=view, samples=options.samples, size=options.size)
            pictures.append(np.asarray(Image.open(path).convert("RGB")))
    # 256 colours are a third of the bytes and look the same
    small = Image.fromarray(np.concatenate(pictures, axis=1)).quantize(256)
    small.save(OUT / f"{name}.png", optimize=True)


def page(strands: int) -> str:
    """docs/hairstyles.md: a picture of each style, what it is, and what it measures."""
    import numpy as np

    from ct2hair_addon.evaluation.hairstyles import STYLES, curl_radius, describe, hairstyle

    parts = [
        "# The hairstyles\n",
        "The project's own hair with known strands, after the paper's ten wigs, and three tied styles. Each takes a number of",
        "strands and a seed: `python -m ct2hair_addon synthesize STYLE --spacing 0.4 --out scan.vdb --strands 8000 --seed 0`.",
        f"The pictures (Cycles, front and back) show {strands:,} strands of seed {SEED}, wider than real ones to make up",
        "for a full head's 100,000. Make pictures and figures again with `.venv/bin/python tests/gallery.py`.\n",
    ]
    for name in STYLES:
        if not (OUT / f"{name}.png").is_file():
            continue
        hair = hairstyle(name, None, 2000, SEED)
        length = hair.lengths()
        low, high = np.quantile(length, [0.05, 0.95])
        figures = f"mean length {length.mean():.0f} mm (nine in ten from {low:.0f} to {high:.0f})"
        if name in CURLED:
            figures += f", curls of {np.median(curl_radius(hair)):.1f} mm radius"
        parts.append(f"## {name}\n\n{describe(name)} {strands:,} strands, {figures}.\n\n![{name}](hairstyles/{name}.png)\n")
    return "\n".join(parts)


if __name__ == "__main__":
    sys.exit(main())
