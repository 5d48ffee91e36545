"""`ct2hair groom`: what the panel does to a result, without a window: edit, simulate, export and picture a job's hair.

It needs Blender: `blender --command ct2hair groom ...`, or a Python that has bpy.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import fields
from pathlib import Path

from .cli import DONE, TerminalObserver, add_command, add_parameter, given
from .errors import CT2HairError
from .settings import SimulationSettings


def add_groom(commands) -> None:
    """The command `groom` and its options, for `cli.main`."""
    parser = add_command(commands, "groom", _groom, "edit, simulate, export and picture a finished result, in Blender")
    parser.add_argument("source", type=Path, help="the folder of a reconstruction, or strands: .npz .bin .data .hair")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for what is written")
    parser.add_argument("--name", default="hair", help="name of the files, without ending")

    strands = parser.add_argument_group("strands of a file")
    strands.add_argument(
        "--head", type=Path, metavar="MESH", help="OBJ of the head they lie on; none fits the mannequin to them"
    )
    strands.add_argument("--source-unit", choices=("auto", "mm", "cm", "m"), default="auto", help="unit of the file")
    strands.add_argument("--source-up", choices=("y", "z"), default="z", help="axis of the file that points up")

    hair = parser.add_argument_group("the hair")
    hair.add_argument("--colour", default="brown", help="pigment: black, brown, blond, ...; a wrong one lists all")
    hair.add_argument("--fuller", action="store_true", help="widths that make up for strands missing from a full head of hair")
    hair.add_argument(
        "--regrow",
        action="append",
        default=[],
        metavar="REGION[=SEED]",
        type=_regrown,
        help="grow a region anew from the guides",
    )
    hair.add_argument(
        "--trim",
        action="append",
        default=[],
        metavar="[REGION=]MM",
        type=_trimmed,
        help="cut a region, or all hair, to a length",
    )

    motion = parser.add_argument_group("motion")
    motion.add_argument(
        "--simulate", nargs=2, type=int, metavar=("FIRST", "LAST"), help="simulate these frames; exports are animated over them"
    )
    for known in fields(SimulationSettings):
        add_parameter(motion, f"--{known.name.replace('_', '-')}", known.name, known)

    out = parser.add_argument_group("what is written")
    out.add_argument(
        "--formats", nargs="+", default=["blend", "alembic", "usd"], metavar="FORMAT",
        help="blend, alembic, usd, picture, bin, data, hair, npz",
    )  # fmt: skip
    out.add_argument("--unit", choices=("m", "cm", "mm"), default="m", help="unit of the Alembic file; Unreal and Maya want cm")
    out.add_argument("--up", choices=("y", "z"), default="y", help="axis of the Alembic file that points up")
    out.add_argument("--strand-unit", choices=("mm", "cm", "m"), default="mm", help="unit of strand files")
    out.add_argument("--strand-up", choices=("y", "z"), default="z", help="axis of strand files that points up")
    out.add_argument("--turntable", type=int, default=0, metavar="N", help="also N pictures all round the head; 0 makes none")
    out.add_argument("--samples", type=int, default=64, help="Cycles samples a pixel of each picture")
    out.add_argument("--size", type=int, default=800, help="pixels of a picture's edge")


def _regrown(text: str) -> tuple[str, int]:
    region, _, seed = text.partition("=")
    try:
        return region, int(seed or 1)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a region, or region=seed such as back=3, got {text!r}") from None


def _trimmed(text: str) -> tuple[str, float]:
    region, separator, length = text.rpartition("=")
    try:
        return region if separator else "all", float(length)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a length in mm, or region=length such as back=150, got {text!r}") from None


def _groom(chosen: argparse.Namespace) -> int:
    from .head import load_obj  # late: it loads numba

    try:
        from . import scene
    except ModuleNotFoundError as error:
        if error.name != "bpy":
            raise
        raise CT2HairError(
            f"groom works in Blender: run `blender --command ct2hair groom ...`, or pip install bpy for {sys.executable}"
        ) from None
    motion = SimulationSettings().changed(given(chosen, [known.name for known in fields(SimulationSettings)]))
    _check(scene, chosen)

    frames = tuple(chosen.simulate) if chosen.simulate else None
    scene.new_file(frames)
    if chosen.source.is_dir():
        result = scene.load_result(chosen.source, colour=chosen.colour)
    else:
        head = load_obj(chosen.head, align=False, need_scalp=False) if chosen.head else None
        result = scene.import_strands(
            chosen.source, unit=chosen.source_unit, up=chosen.source_up, head=head, colour=chosen.colour
        )
    for region, seed in chosen.regrow:
        print(f"{scene.regrow(result, region, seed=seed)} strands grown anew: {region}")
    for region, length in chosen.trim:
        print(f"{scene.trim(result, length, region)} strands cut to {length:g} mm: {region}")
    if chosen.fuller:
        scene.set_width_factor(result.hair, scene.full_width_factor(result.hair))
    print(f"{'region':8}{'strands':>9}{'a cm²':>8}{'mm long':>9}{'backed':>8}")
    for region, measured in scene.measure_regions(result).items():
        shares = f"{measured.density:8.0f}{measured.length:9.0f}{measured.support:8.2f}"
        print(f"{region:8}{measured.strands:9}{shares}")
    chosen.out.mkdir(parents=True, exist_ok=True)
    if frames is not None:
        observer = TerminalObserver()
        done = scene.simulate(
            result,
            motion,
            frames=frames,
            cache=chosen.out / "simulation.pc2",
            progress=lambda done, total: observer.progressed("simulation", 0.0, done / total, None),
        )
        print(f"{done.guides} guides simulated: tips moved {done.tip:.0f} mm, {done.inside:.1%} of the points in the head")
    with scene.quiet():
        paths = scene.export_all(
            result,
            chosen.out,
            formats=tuple(chosen.formats),
            name=chosen.name,
            unit=chosen.unit,
            up=chosen.up,
            strand_unit=chosen.strand_unit,
            strand_up=chosen.strand_up,
            frames=frames,
            samples=chosen.samples,
            size=chosen.size,
        ).values()
        turn = {"frames": chosen.turntable, "samples": chosen.samples, "size": chosen.size}
        pictures = scene.render_turntable(result, chosen.out, **turn) if chosen.turntable else []
    for path in (*paths, *pictures):
        print(path)
    return DONE


def _check(scene, chosen: argparse.Namespace) -> None:
    """Refuse what is wrong before anything is loaded or written."""
    regions = ["all", *scene.REGIONS]
    for option, values, known in (
        ("colour", [chosen.colour], scene.HAIR_COLOURS),
        ("formats", chosen.formats, scene.FORMATS),
        ("regrow", [region for region, _ in chosen.regrow], regions),
        ("trim", [region for region, _ in chosen.trim], regions),
    ):
        for value in values:
            if value not in known:
                raise CT2HairError(f"--{option} {value}: not known; choose of {', '.join(known)}")
    turn = chosen.turntable or 2  # 0 is none
    for option, value, least in (("samples", chosen.samples, 1), ("size", chosen.size, 16), ("turntable", turn, 2)):
        if value < least:
            raise CT2HairError(f"--{option} {value}: expected {least} or more")
    if chosen.simulate and chosen.simulate[0] >= chosen.simulate[1]:
        raise CT2HairError("--simulate {} {}: expected the last frame after the first".format(*chosen.simulate))
    if not chosen.source.exists():
        raise CT2HairError(f"{chosen.source}: there is no such folder or file")
    if chosen.head and chosen.source.is_dir():
        raise CT2HairError(f"--head is for strands of a file; {chosen.source} has a head of its own")
