#!/usr/bin/env python3
"""Asks ipctk, a library that knows nothing of Toile, whether cloth cuts itself.

    toile simulate SCENE --walk WALK --frames N --export walk.glb --table walk.csv
    python3 examples/crossings.py walk.glb walk.csv

Needs `pip install ipctk numpy`. Prints how many frames both call whole, how many both call cut, and
those of which they differ; fails if there are any.
"""

import csv
import json
import struct
import sys

import ipctk
import numpy


def read(path):
    """The last mesh of a glTF file: its triangles, and its vertices frame by frame (m)."""
    data = open(path, "rb").read()
    length = struct.unpack_from("<I", data, 12)[0]
    root = json.loads(data[20 : 20 + length])
    binary = memoryview(data)[28 + length :]

    def values(number, kind, width):
        accessor = root["accessors"][number]
        view = root["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        found = numpy.frombuffer(binary, kind, accessor["count"] * width, start)
        return found.reshape(-1, width)

    cloth = root["meshes"][-1]["primitives"][0]
    triangles = values(cloth["indices"], "<u4", 1).reshape(-1, 3).astype(numpy.int32)
    first = values(cloth["attributes"]["POSITION"], "<f4", 3).astype(float)
    ways = (values(t["POSITION"], "<f4", 3) for t in cloth.get("targets", []))
    return triangles, [first] + [first + way for way in ways]


def main(export, table):
    triangles, frames = read(export)
    with open(table, newline="") as rows:
        ours = [int(row["crossings"]) > 0 for row in csv.DictReader(rows)]
    if len(ours) != len(frames):
        sys.exit(f"{export} has {len(frames)} frames, {table} {len(ours)}: of which walk are they?")
    mesh = ipctk.CollisionMesh(frames[0], ipctk.edges(triangles), triangles)
    theirs = [bool(ipctk.has_intersections(mesh, frame)) for frame in frames]
    both = list(zip(ours, theirs))
    differ = [frame for frame, (our, their) in enumerate(both) if our != their]
    print(
        f"{len(both)} frames: {both.count((False, False))} whole, {both.count((True, True))} cut,"
        f" {len(differ)} of which ipctk says otherwise"
        + "".join(f"\n  frame {frame}: ipctk {theirs[frame]}" for frame in differ)
    )
    return len(differ) > 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
