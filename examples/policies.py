#!/usr/bin/env python3
"""Policies against one another, under players who favour some clips.

    python3 examples/policies.py SCENE --clips walk,turn --frames 3000 --step 250 --out policies

One store is initialised; players walk these clips on it, and their counts are left in the store. Copies of it
are explored by every policy, and by greedy restricted to the clips. Prints a CSV row a step: policy, frames,
worst merge of the best prefix, and the 95th percentile and mean of merges as these players pass them (mm).
"""

import argparse
import json
import pathlib
import shutil
import subprocess
import time


def run(*command):
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


def walk(a, store):
    """Leaves the counts of players who go round and round through the clips."""
    serve = subprocess.Popen(
        [a.toile, "serve", "--store", store, "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"],
        stdout=subprocess.PIPE, text=True)
    try:
        said = {}
        while "fingerprint" not in said:
            key, value = serve.stdout.readline().split()
            said[key] = value
        run(a.toile, "play", "--connect", said["quic"], "--fingerprint", said["fingerprint"],
            "--walk", f"clip:{a.clips}", "--frames", str(a.walked), "--json")
        time.sleep(12)  # a server writes what was walked every ten seconds
    finally:
        serve.terminate()
        serve.wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scene")
    parser.add_argument("--clips", required=True)
    parser.add_argument("--walked", type=int, default=3000)
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--step", type=int, default=250)
    parser.add_argument("--workers", default="1")
    parser.add_argument("--vertices", help="of the garment; default: as the scene says")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--toile", default="toile")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    base = a.out / "base"
    explore = [a.toile, "explore", "--scene", a.scene, "--workers", a.workers, "--json"]
    explore += ["--vertices", a.vertices] if a.vertices else []
    first = run(*explore, "--store", str(base), "--frames", "1")
    walk(a, str(base))
    print("policy,frames,best_worst_mm,visited_p95_mm,visited_mean_mm")
    for name, more in [("greedy", []), ("restricted", ["--clips", a.clips]),
                       ("visited", ["--policy", "visited"]), ("predictive", ["--policy", "predictive"])]:
        store = a.out / name
        for ending in ["", ".work"]:
            shutil.copytree(f"{base}{ending}", f"{store}{ending}", dirs_exist_ok=True)
        for frames in range(a.step, a.frames + 1, a.step):
            total = first["simulated_frames"] + frames
            found = run(*explore, "--store", str(store), *more, "--frames", str(total))
            print(f"{name},{found['simulated_frames']},{found['best_worst_error_mm']:.2f},"
                  f"{found['visited_p95_mm']:.3f},{found['visited_mean_mm']:.4f}", flush=True)


if __name__ == "__main__":
    main()
