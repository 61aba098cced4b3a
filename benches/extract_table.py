#!/usr/bin/env python3
"""Wraps fields from the command line and prints a Markdown table of what came out.

    python3 benches/extract_table.py                  the example scenes, and Bunny (network), Spot, Bunny and Duck where
                                                      the shared test data are
    python3 benches/extract_table.py FILE... [-- EXTRACT OPTIONS]

Distances are in percent of the bounding-box diagonal, both ways, largest; seconds are for shrinking alone, on this
machine and whatever else it is doing. Exits 1 when any field could not be wrapped soundly.
"""
import json
import os
import pathlib
import subprocess
import sys
import tempfile

root = pathlib.Path(__file__).resolve().parent.parent
arguments, options = sys.argv[1:], []
if "--" in arguments:
    cut = arguments.index("--")
    arguments, options = arguments[:cut], arguments[cut + 1 :]
fields = [pathlib.Path(a) for a in arguments]
if not fields:
    fields = sorted((root / "examples/scenes").glob("*.json"))
    shared = pathlib.Path(os.environ.get("SHRINKD_DATA", root.parent / "shared/data"))
    wanted = ["networks/neural-implicit-queries/bunny.npz"] + [f"meshes/paper/{n}.ply" for n in ("spot", "bunny", "duck")]
    fields += [shared / name for name in wanted if (shared / name).exists()]
    if len(fields) and not shared.exists():
        print(f"the shared test data are not at {shared}: only the example scenes", file=sys.stderr)

subprocess.run(["cargo", "build", "--release", "--quiet"], cwd=root, check=True)
metadata = subprocess.run(
    ["cargo", "metadata", "--format-version", "1", "--no-deps"], cwd=root, check=True, capture_output=True, text=True
)
program = pathlib.Path(json.loads(metadata.stdout)["target_directory"]) / "release/shrinkd"

print("| field | vertices | evaluations per vertex | flips | self-intersections | NC | max distance | area p1-p99 | seconds |")
print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
failed = 0
with tempfile.TemporaryDirectory() as folder:
    for field in fields:
        report = pathlib.Path(folder) / "report.json"
        report.unlink(missing_ok=True)
        command = [program, "extract", field, "-o", pathlib.Path(folder) / "out.glb", "--report", report, *options]
        ended = subprocess.run(command, capture_output=True, text=True)
        failed += ended.returncode != 0
        name = field.name if field.suffix != ".json" else field.stem
        if not report.exists():
            print(f"| {name} | exit {ended.returncode}: {ended.stderr.strip().splitlines()[-1]} |||||||", flush=True)
            continue
        r = json.loads(report.read_text())
        sphere = r["distortion"]["sphere"]
        print(
            f"| {name} | {r['vertices']:,} | {r['evaluations']['per_vertex']:.1f} | {sum(r['flips'].values())}"
            f" | {r['self_intersections']} | {r['normal_consistency']:.4f} | {100 * r['distance']['max']:.2f} %"
            f" | {sphere['area_p1']:.2f}-{sphere['area_p99']:.2f} | {r['seconds']['shrink']:.2f} |",
            flush=True,
        )
sys.exit(1 if failed else 0)
