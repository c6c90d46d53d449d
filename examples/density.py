#!/usr/bin/env python3
"""States, error, bytes and CPU against the density of the motion graph: the curse of dimensionality.

    python3 examples/density.py SCENE.toml --to walk,run --seconds 8 4 2 1 0.5 --frames 2000 --out curve

For every density the motion graph is computed, put into a copy of the scene beside it, and explored until the initial
pass and FRAMES more frames are simulated. Prints one Markdown row a density.
"""

import argparse
import json
import pathlib
import re
import subprocess


def run(*command):
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.strip().splitlines()[-1]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=pathlib.Path)
    parser.add_argument("--to", default="")
    parser.add_argument("--seconds", type=float, nargs="+", default=[8, 4, 2, 1, 0.5])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--toile", default="toile")
    parser.add_argument("--workers", default="1")
    parser.add_argument("--vertices", default="", help="of the garment; default: as the scene says")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    text = a.scene.read_text()
    print("| median reach (s) | transitions | poses | states | worst merge after the initial pass (mm) "
          "| worst merge (mm) | mean merge (mm) | CPU (s) | store (MB) |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for seconds in a.seconds:
        graph = a.out / f"graph-{seconds}.json"
        to = ["--to", a.to] if a.to else []
        run(a.toile, "scene", "graph", str(a.scene), "--density", str(seconds), *to, "--out", str(graph))
        table = f'[motion_graph]\nfile = "{graph.resolve()}"\n\n'
        dense = re.sub(r"\[motion_graph\]\n.*?\n(?=\[)", lambda _: table, text, flags=re.S)
        # Beside the scene, whose paths are relative to it; it stays, so that the store can be compared and explored on.
        scene = a.scene.parent / f"{a.scene.stem}-reach-{seconds}.toml"
        scene.write_text(dense)
        check = json.loads(run(a.toile, "scene", "check", str(scene), "--json"))
        store = str(a.out / f"store-{seconds}")
        explore = [a.toile, "explore", "--scene", str(scene), "--store", store,
                   "--workers", a.workers, "--json", "--frames"]
        explore[2:2] = ["--vertices", a.vertices] if a.vertices else []
        first = json.loads(run(*explore, str(check["edges"])))
        last = json.loads(run(*explore, str(check["edges"] + a.frames)))
        size = sum(f.stat().st_size for f in pathlib.Path(store).rglob("*") if f.is_file())
        transitions = len(json.loads(graph.read_text())["transitions"])
        print(f"| {seconds} | {transitions} | {check['poses']} | {last['states']} "
              f"| {first['worst_error_mm']:.0f} | {last['worst_error_mm']:.0f} "
              f"| {last['mean_error_mm']:.1f} | {last['simulate_cpu_s']:.0f} | {size / 1e6:.1f} |",
              flush=True)


if __name__ == "__main__":
    main()
