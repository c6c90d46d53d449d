#!/usr/bin/env python3
"""Strips of pictures, streamed: a garment on the real character through a cartwheel, or a hood that falls in a run.

    python3 examples/strips.py --out docs/cartwheel.png [--garment robe-real] [--toile target/release/toile]
    python3 examples/strips.py --what hood --vertices 1500 --frames 320 --out docs/hood.png

Makes a small scene of a shipped garment (walking backwards, a cartwheel, and on; or turning, a run, and walking),
explores it until every pose is simulated once, serves it, and has `toile play` draw what a player decodes. Two
hundred simulated frames for the cartwheel, 690 for the hood: half a minute of CPU each. Needs $TOILE_DATA.
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


def transition(from_clip, from_frame, to_clip, to_frame, distance_m):
    return {"from_clip": from_clip, "from_frame": from_frame, "to_clip": to_clip, "to_frame": to_frame,
            "distance_m": distance_m}


# Clips with their frames, transitions as `toile scene graph` or the data folder has them, start, edges.
STRIPS = {
    "cartwheel": (
        {"walk_backward": 141, "cartwheel": 115},
        [transition("walk_backward", 101, "cartwheel", 0, 0.2571),
         transition("cartwheel", 112, "walk_backward", 6, 0.1891)],
        ("walk_backward", 98), 209),
    # One round, so that nothing is merged before the walk after the run is over.
    "hood": (
        {"turn_left": 276, "run_figure8": 244, "walk_figure8": 460},
        [transition("turn_left", 187, "run_figure8", 10, 0.052),
         transition("run_figure8", 243, "walk_figure8", 5, 0.084),
         transition("walk_figure8", 245, "turn_left", 0, 0.0823)],
        ("turn_left", 172), 690),
}


def scene(folder, garment, what):
    clips, transitions, (clip, frame), _ = STRIPS[what]
    graph = folder / "graph.json"
    graph.write_text(json.dumps({
        "fps": 30, "metric": "as toile scene graph measures it",
        "clips": [{"name": name, "frames": frames} for name, frames in clips.items()], "transitions": transitions}))
    text = (ROOT / "scenes" / f"{garment}.toml").read_text()
    text = re.sub(r"\[motion_graph\]\n.*?\n(?=\[)", lambda _: f'[motion_graph]\nfile = "{graph}"\n\n', text, flags=re.S)
    file = folder / f"{garment}.toml"
    file.write_text(text.replace("fps = 30.0\n", f'fps = 30.0\nstart = {{ clip = "{clip}", frame = {frame} }}\n', 1))
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
    parser.add_argument("--what", choices=list(STRIPS), default="cartwheel")
    parser.add_argument("--garment", default="robe-real")
    parser.add_argument("--vertices", help="of the garment; default: as its scene says")
    parser.add_argument("--out", required=True)
    parser.add_argument("--toile", default=str(ROOT / "target/release/toile"))
    parser.add_argument("--frames", type=int, default=128)
    parser.add_argument("--shots", default="16")
    parser.add_argument("--workers", default="2")
    a = parser.parse_args()
    assert "TOILE_DATA" in os.environ, "set TOILE_DATA to the folder of the real character"
    with tempfile.TemporaryDirectory() as folder:
        store = f"{folder}/store"
        file = scene(pathlib.Path(folder), a.garment, a.what)
        more = ["--vertices", a.vertices] if a.vertices else []
        subprocess.run([a.toile, "explore", "--scene", str(file), "--store", store, "--frames", str(STRIPS[a.what][3]),
                        "--workers", a.workers, *more], check=True)
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
