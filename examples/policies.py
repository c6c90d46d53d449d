#!/usr/bin/env python3
"""Policies against one another, under players who favour some clips.

    python3 examples/policies.py robe-real casual --clips walk,turn --starts walk:40,run:10 --frames 3000 --out policies

For every scene and start pose one store is initialised; players walk these clips on it, and their counts are
left in the store. Copies of it are explored by every policy, and by greedy restricted to the clips. Prints a CSV
row a step: scene, start, policy, frames beyond the initial ones, worst merge of the best prefix, and the 95th
percentile and mean of merges as these players pass them (mm), and how many they pass in a second. Then a table:
frames to bring the worst merge to parts of what it was, and what these players see at the end (mm; the last column
is the sum of merges that they pass in a second of play).
"""

import argparse
import json
import pathlib
import shutil
import subprocess
import sys
import time

POLICIES = {
    "greedy": [],
    "restricted": None,
    "visited": ["--policy", "visited"],
    "predictive": ["--policy", "predictive"],
}
LEVELS = [0.95, 0.9, 0.85, 0.8, 0.7]


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


def scene_at(a, scene, start):
    """A copy of the scene's file that starts at CLIP:FRAME; the scene itself where no start is given."""
    if not start:
        return scene
    clip, frame = start.split(":")
    file = pathlib.Path(scene) if scene.endswith(".toml") else a.scenes.joinpath(f"{scene}.toml")
    if not file.exists():
        sys.exit(f"--starts: there is no {file} to start elsewhere; a built-in scene has no file, leave --starts out")
    text = file.read_text()
    copy = a.out / f"{pathlib.Path(scene).stem}-{clip}-{frame}.toml"
    copy.write_text(f'start = {{ clip = "{clip}", frame = {frame} }}\n{text}')
    return str(copy)


def explored(a, scene, start):
    """Rows of every policy on one scene from one start pose: name to [frames, worst, p95, mean]."""
    name = f"{pathlib.Path(scene).stem}-{start.replace(':', '-')}"
    base = a.out / name
    vertices = dict(pair.split("=") for pair in a.vertices.split(",") if pair)
    explore = [a.toile, "explore", "--scene", scene_at(a, scene, start), "--workers", a.workers, "--json"]
    explore += ["--vertices", vertices[scene]] if scene in vertices else []
    first = run(*explore, "--store", str(base), "--frames", "1")
    walk(a, str(base))
    rows = {}
    for policy, more in POLICIES.items():
        more = ["--clips", a.clips] if more is None else more
        store = a.out / f"{name}-{policy}"
        for ending in ["", ".work"]:
            shutil.copytree(f"{base}{ending}", f"{store}{ending}", dirs_exist_ok=True)
        rows[policy] = [[0, first["worst_error_mm"], None, None, None]]
        for frames in range(a.step, a.frames + 1, a.step):
            total = first["simulated_frames"] + frames
            found = run(*explore, "--store", str(store), *more, "--frames", str(total))
            row = [found["simulated_frames"] - first["simulated_frames"], found["best_worst_error_mm"],
                   found["visited_p95_mm"], found["visited_mean_mm"], found["visited_merges_per_s"]]
            rows[policy].append(row)
            print(f"{scene},{start},{policy},{row[0]},{row[1]:.2f},{row[2]:.3f},{row[3]:.4f},{row[4]:.4f}", flush=True)
        for ending in ["", ".work"]:
            shutil.rmtree(f"{store}{ending}")
    return rows


def frames_to(rows, level):
    """Frames after which the worst merge was at most so large, looked at step by step; None: never."""
    return next((frames for frames, worst, *_ in rows if worst <= level), None)


def table(rows):
    """What is compared, one line a policy."""
    worst = rows["greedy"][0][1]
    heads = [f"frames to {level * worst:.0f} mm" for level in LEVELS]
    print("| policy | " + " | ".join(heads) + " | frames | worst | seen p95 | seen mean | seen a second |")
    print("| --- |" + " ---: |" * (len(LEVELS) + 5))
    for policy, found in rows.items():
        cells = ["-" if (at := frames_to(found, level * worst)) is None else f"{at:,}" for level in LEVELS]
        frames, last, p95, mean, merges = found[-1]
        cells += [f"{frames:,}", f"{last:.0f}", f"{p95:.0f}", f"{mean:.0f}", f"{mean * merges:.0f}"]
        print(f"| {policy} | " + " | ".join(cells) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", nargs="+")
    parser.add_argument("--clips", required=True, help="those that players favour")
    parser.add_argument("--starts", default="", help="CLIP:FRAME,...; default: where the scene starts")
    parser.add_argument("--walked", type=int, default=3000)
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--step", type=int, default=250)
    parser.add_argument("--workers", default="1")
    parser.add_argument("--vertices", default="", help="of garments, SCENE=N,...; default: as the scene says")
    parser.add_argument("--scenes", type=pathlib.Path, default=pathlib.Path(__file__).parent.parent / "scenes")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--toile", default="toile")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    print("scene,start,policy,frames,best_worst_mm,visited_p95_mm,visited_mean_mm,merges_per_s")
    found = {}
    for scene in a.scene:
        for start in a.starts.split(","):
            found[scene, start] = explored(a, scene, start)
    for (scene, start), rows in found.items():
        print(f"\n{scene} {start}\n")
        table(rows)


if __name__ == "__main__":
    main()
