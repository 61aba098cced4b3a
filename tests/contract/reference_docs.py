#!/usr/bin/env python3
"""Holds the reference pages against openapi.yaml, which the gate holds against the code.

    python3 tests/contract/reference_docs.py

Every member and every word that the description has for an option, a figure, an output or a fit must stand in backticks on the page that
explains it, and every member that a table of those pages names must be in the description. Exits 1 and says what is missing. Needs Python
3.9 and nothing else: of YAML it knows what the program writes.
"""

import pathlib
import re
import sys

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]

# page, the schemas whose members and words it explains, and the headings whose tables name members of them
PAGES = [
    ("docs/options.md", ["ShrinkSpec", "Budget", "LatticeSpec", "Method", "Density", "DistortionKept", "OnTopology", "ComponentName",
      "FoundTopology"],
     ["`shrink`", "`budget`"]),
    ("docs/metrics.md",
     ["Report", "Closeness", "Distance", "OneWay", "Flips", "Distortions", "Distortion", "Evaluations", "Counts", "Verdict", "Finding", "WarmStart", "Moved",
      "Seconds", "CurveReport", "ArcLength", "LeftOut"],
     ["Topology and folds", "Parameterization", "Success"]),
    ("docs/outputs.md", ["OutputName"], []),
    ("docs/fitting.md", ["FitSpec", "Sampling", "FitReport", "ShapeReport", "SensitivityReport"], []),
    ("docs/networks.md", ["FieldOptions", "Family", "Sign"], ["Options"]),
]


def schemas(text):
    """{name: (members, words)} of every schema of the description."""
    found, name, path = {}, None, []
    inside = text.split("\n  schemas:\n")[1].split("\n  securitySchemes:\n")[0]
    for line in inside.splitlines():
        indent, content = len(line) - len(line.lstrip()), line.strip()
        if indent == 4 and content.endswith(":"):
            name, path = content[:-1], []
            found[name] = (set(), set())
            continue
        while path and path[-1][0] >= indent + (content.startswith("- ")):
            path.pop()
        if path and path[-1][1] == "properties" and re.fullmatch(r"\w+:.*", content):
            found[name][0].add(content.split(":")[0])
        if path and path[-1][1] == "enum" and content.startswith("- "):
            found[name][1].add(content[2:])
        key = content[2:] if content.startswith("- ") else content
        if key.endswith(":"):
            path.append((indent + (2 if content.startswith("- ") else 0), key[:-1]))
    return found


def words(text):
    """Every word that stands in backticks, the parts of dotted names and of JSON by themselves."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    return {word for span in re.findall(r"`([^`\n]+)`", text) for word in re.findall(r"\w+", span)}


def rows(text, heading):
    """The members in the first column of the tables below a heading."""
    below = re.split(rf"^##+ {re.escape(heading)}$", text, flags=re.M)
    if len(below) < 2:
        raise SystemExit(f"there is no heading {heading!r} any more")
    section = re.split(r"^##+ ", below[1], flags=re.M)[0]
    first = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return {name.strip(".").split(".")[-1] for cell in first for name in re.findall(r"`([\w.]+)`", cell)}


def main():
    description = schemas((REPOSITORY / "openapi.yaml").read_text())
    wrong = []
    for page, names, headings in PAGES:
        text = (REPOSITORY / page).read_text()
        explained = words(text)
        for name in names:
            if name not in description:
                wrong.append(f"{page}: the description has no {name} any more")
                continue
            members, values = description[name]
            wrong += [f"{page}: nothing about `{one}` of {name}" for one in sorted((members | values) - explained)]
        there = {one for members, values in description.values() for one in members | values}
        for heading in headings:
            wrong += [f"{page}: {heading} has `{one}`, which the description has not" for one in sorted(rows(text, heading) - there)]
    print("\n".join(wrong) or f"{len(PAGES)} pages say what the description says")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
