#!/usr/bin/env python3
"""Runs S1 and S2 with MuJoCo, Blender and Toile in turn and prints a table with ratios.

    cloth/peers/compare.sh [--n 32 100] [--repeats 3] [--out docs/results/peers.md]

compare.sh makes the Python environment and builds Toile. The peers' scripts (mujoco_peer.py, blender_peer.py, common.py) are
looked for in $TOILE_PEERS, then in `peers` beside $TOILE_DATA. All times are processor time of one thread in milliseconds per
1/60 s of simulated time; the runs alternate, so that a neighbour's load falls on all alike. Each figure is the median.
"""
import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent


def peers_folder():
    places = []
    if os.environ.get("TOILE_PEERS"):
        places.append(pathlib.Path(os.environ["TOILE_PEERS"]))
    if os.environ.get("TOILE_DATA"):
        places.append(pathlib.Path(os.environ["TOILE_DATA"]).resolve().parent / "peers")
    for place in places:
        if (place / "mujoco_peer.py").is_file():
            return place
    sys.exit("the peers' scripts were not found: set TOILE_PEERS to the folder that holds mujoco_peer.py")


def last_json(command, cwd=None):
    """The object on the last line of a command's output that is one, or None with the reason on stderr."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    for line in reversed(done.stdout.splitlines()):
        if line.startswith("{"):
            return json.loads(line)
    print(f"{' '.join(map(str, command))}: {done.stderr.strip()[-400:]}", file=sys.stderr)
    return None


def peer(folder, script, scene, n, *options):
    found = last_json([sys.executable, script, scene, str(n), "--repeats", "1", *options], cwd=folder)
    if found is None or "stretch_p99" not in found:
        return None
    return dict(ms=found["ms_frame"], p99=found["stretch_p99"], most=found["stretch_max"], hits=found["self_hits"],
                pen=found.get("pen_vertex_mm", 0.0), low=found["low_z"], speed=found["max_speed"], frames=found["frames"])


def toile(binary, scene, n, *options):
    found = last_json([binary, "lab", "run", scene, "--n", str(n), "--json", *options])
    if found is None:
        return None
    return dict(ms=found["cpu_ms_per_frame"], p99=found["stretch_p99_pct"], most=found["stretch_max_pct"],
                hits=found["self_hits"], pen=found["penetration_mm"], low=found["lowest_m"],
                speed=found["speed_max_m_s"], frames=found["frames"])


def middle(runs):
    """Median time; the other figures of the first run (they do not depend on the clock)."""
    runs = [r for r in runs if r]
    if not runs:
        return None
    return dict(runs[0], ms=statistics.median(r["ms"] for r in runs), spread=[min(r["ms"] for r in runs), max(r["ms"] for r in runs)])


def main():
    ask = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    ask.add_argument("--n", type=int, nargs="*", default=[32, 100])
    ask.add_argument("--scenes", nargs="*", default=["S1", "S2"])
    ask.add_argument("--repeats", type=int, default=3)
    ask.add_argument("--out", type=pathlib.Path)
    ask.add_argument("--binary", type=pathlib.Path, default=ROOT / "target" / "release" / "toile")
    a = ask.parse_args()
    folder = peers_folder()
    candidates = {
        "MuJoCo, 1 step": lambda s, n: peer(folder, "mujoco_peer.py", s, n, "--opt", "substeps=1"),
        "Blender, quality 5": lambda s, n: peer(folder, "blender_peer.py", s, n, "--opt", "quality=5"),
        "Toile": lambda s, n: toile(a.binary, s, n),
    }
    lines = ["| scene | vertices | simulator | CPU ms per 1/60 s (least - most) | against Toile | p99 / max stretch % | self hits | "
             "penetration mm | lowest m | fastest m/s | frames |", "| --- " * 11 + "|"]
    for scene in a.scenes:
        for n in a.n:
            runs = {name: [] for name in candidates}
            for repeat in range(a.repeats):
                for name, run in candidates.items():
                    print(f"{scene} {n}x{n}, run {repeat + 1}: {name}", file=sys.stderr, flush=True)
                    runs[name].append(run(scene, n))
            found = {name: middle(r) for name, r in runs.items()}
            own = found["Toile"]
            for name, r in found.items():
                if r is None:
                    lines.append(f"| {scene} | {n * n} | {name} | no result |" + " |" * 7)
                    continue
                ratio = f"{r['ms'] / own['ms']:.2f}x" if own else ""
                lines.append(f"| {scene} | {n * n} | {name} | {r['ms']:.2f} ({r['spread'][0]:.2f} - {r['spread'][1]:.2f}) | {ratio} | "
                             f"{r['p99']:.2f} / {r['most']:.2f} | {r['hits']} | {r['pen']:.2f} | {r['low']:.3f} | {r['speed']:.1f} | "
                             f"{r['frames']} |")
    table = "\n".join(lines)
    print(table)
    if a.out:
        head = ("# Beside other simulators\n\n"
                "Printed by `cloth/peers/compare.sh --out docs/results/peers.md`: all simulators in turn, on one machine, in one run;\n"
                + ("one run each" if a.repeats == 1 else f"medians of {a.repeats} runs") + ", one thread's processor time. The scenes are `toile lab run S1` and `S2`.\n"
                "Stretch is that of the frame in which the sheet is lowest; compare p99 (the pinned corner is a singularity).\n"
                "MuJoCo has no self-collision here, Blender and Toile have.\n\n")
        a.out.write_text(head + table + "\n")


if __name__ == "__main__":
    main()
