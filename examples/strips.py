#!/usr/bin/env python3
"""Strips of pictures, streamed: a garment on the real character through a cartwheel.

    python3 examples/strips.py --garment robe-real --out docs/cartwheel.png [--toile target/release/toile]

Makes a small scene of a shipped garment (walking backwards, a cartwheel, and on), explores it until every pose
is simulated once, serves it, and has `toile play` draw what a player decodes. Two hundred simulated frames: half a
minute of CPU for robe-real. Needs $TOILE_DATA.
"""

import argparse
import json
import os
import pathlib
import re
import subprocess
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
GRAPH = {
    "fps": 30, "metric": "as toile scene graph measures it",
    "clips": [{"name": "walk_backward", "frames": 141}, {"name": "cartwheel", "frames": 115}],
    "transitions": [
        {"from_clip": "walk_backward", "from_frame": 101, "to_clip": "cartwheel", "to_frame": 0, "distance_m": 0.2571},
        {"from_clip": "cartwheel", "from_frame": 112, "to_clip": "walk_backward", "to_frame": 6, "distance_m": 0.1891},
    ],
}
START = 'start = { clip = "walk_backward", frame = 98 }'
EDGES = 209


def scene(folder, garment):
    graph = folder / "graph.json"
    graph.write_text(json.dumps(GRAPH))
    text = (ROOT / "scenes" / f"{garment}.toml").read_text()
    text = re.sub(r"\[motion_graph\]\n.*?\n(?=\[)", lambda _: f'[motion_graph]\nfile = "{graph}"\n\n', text, flags=re.S)
    file = folder / f"{garment}.toml"
    file.write_text(text.replace("fps = 30.0\n", f"fps = 30.0\n{START}\n", 1))
    return file


def small(file):
    """For a page: fewer pixels, a palette; left as it is without Pillow."""
    try:
        from PIL import Image
    except ImportError:
        return
    image = Image.open(file).convert("RGB")
    image = image.resize((1200, image.height * 1200 // image.width), Image.LANCZOS)
    image.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=3).save(file, optimize=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--garment", default="robe-real")
    parser.add_argument("--out", required=True)
    parser.add_argument("--toile", default=str(ROOT / "target/release/toile"))
    parser.add_argument("--frames", type=int, default=128)
    parser.add_argument("--shots", default="16")
    parser.add_argument("--workers", default="2")
    a = parser.parse_args()
    assert "TOILE_DATA" in os.environ, "set TOILE_DATA to the folder of the real character"
    with tempfile.TemporaryDirectory() as folder:
        store = f"{folder}/store"
        subprocess.run([a.toile, "explore", "--scene", str(scene(pathlib.Path(folder), a.garment)), "--store", store,
                        "--frames", str(EDGES), "--workers", a.workers], check=True)
        said = open(f"{folder}/said", "w+")
        server = subprocess.Popen([a.toile, "serve", "--store", store, "--listen", "127.0.0.1:4497",
                                   "--http", "127.0.0.1:0"], stdout=said, stderr=subprocess.DEVNULL)
        try:
            found = None
            for _ in range(100):
                found = re.search(r"[0-9a-f]{64}", pathlib.Path(said.name).read_text())
                if found:
                    break
                time.sleep(0.1)
            subprocess.run([a.toile, "play", "--connect", "127.0.0.1:4497", "--fingerprint", found[0], "--walk",
                            "random:1", "--frames", str(a.frames), "--shots", a.shots, "--picture", a.out, "--json"],
                           check=True)
            small(a.out)
        finally:
            server.terminate()
            server.wait(20)


if __name__ == "__main__":
    main()
