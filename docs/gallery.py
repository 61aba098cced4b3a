#!/usr/bin/env python3
"""Makes docs/gallery.md and its pictures anew.

    cargo build --release
    python3 docs/gallery.py target/release/shrinkd

Every picture and every figure comes from the program; nothing is chosen by its result.
"""

import pathlib
import subprocess
import sys
import tempfile

DOCS = pathlib.Path(__file__).resolve().parent
SCENES = DOCS.parent / "examples" / "scenes"
BESIDE = ["fork", "starfish", "gear", "cup", "pawn", "notched_block"]
STRIPS = ["starfish", "pawn", "fork"]
LATTICE = "latlong:200x100"


def run(*command):
    # the paper's method makes what does not pass, and `compare` says so by its exit code
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stderr}")


def strips(program, images):
    lines = []
    for name in STRIPS:
        picture = f"strip-{name}.png"
        with tempfile.TemporaryDirectory() as folder:
            glb = pathlib.Path(folder, "out.glb")
            run(program, "extract", SCENES / f"{name}.json", "-o", glb, "--filmstrip", images / picture)
        lines.append(f"![{name}, from the sphere to the surface](images/gallery/{picture})\n")
    return lines


def side_by_side(program, images):
    with tempfile.TemporaryDirectory() as folder:
        only = [word for name in BESIDE for word in ("--only", f"{name}.json")]
        run(program, "compare", SCENES, "--lattice", LATTICE, "--side-by-side", "--out", folder, *only)
        made = pathlib.Path(folder, f"side-by-side-{LATTICE.replace(':', '-')}.png")
        (images / "side-by-side.png").write_bytes(made.read_bytes())
        report = pathlib.Path(folder, "compare.md").read_text()
    table = report.split("## Side by side\n", 1)[1].strip()
    return ["![Marching cubes, the paper's method and shrinkd side by side](images/gallery/side-by-side.png)\n", table + "\n"]


def main():
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    program = pathlib.Path(sys.argv[1]).resolve()
    images = DOCS / "images" / "gallery"
    images.mkdir(parents=True, exist_ok=True)
    version = subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    page = [
        "# Gallery\n",
        f"Made by `python3 docs/gallery.py target/release/shrinkd` with {version}. All shapes are scenes of `examples/scenes`; the lattice is {LATTICE}.\n",
        "## Shrinking\n",
        "Six frames of one scale, by `shrinkd extract SCENE -o OUT.glb --filmstrip STRIP.png`: the sphere, fronts of the contraction, the surface. How fronts get the "
        "checkerboard before the map is made is told in [outputs](outputs.md#filmstrip).\n",
        *strips(program, images),
        "## Side by side\n",
        "By `shrinkd compare examples/scenes --side-by-side --out RESULTS`: marching cubes of as many vertices, which has no UVs; the paper's loop as printed; and the surface "
        "that shrinkd makes. Triangles seen from behind are red, so folds show. A green bar has passed every check.\n",
        *side_by_side(program, images),
    ]
    (DOCS / "gallery.md").write_text("\n".join(page))


if __name__ == "__main__":
    main()
