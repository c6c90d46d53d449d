#!/usr/bin/env python3
"""The loop closed: players favour some clips and after a while others; the explorer hears of it and follows.

    python3 examples/loop.py robe-real --clips walk,turn --then run,jump --vertices 900 --out loop

One store is initialised. Then for `visited` and for `greedy` a copy of it gets a server, real players who walk
these clips in real time, and an explorer; they meet in the store alone. Prints a CSV row a step: policy, seconds,
frames beyond the initial ones, what the players see of merges by the counts that have arrived (mean and 95th
percentile in mm, merges passed in a second), and the clips that they favour by then.
"""

import argparse
import json
import pathlib
import shutil
import subprocess
import threading
import time


def run(*command):
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


class Players:
    """A server over a store, and players who walk the clips until they are told others."""

    def __init__(self, a, store):
        self.a, self.clips, self.over = a, a.clips, False
        self.server = subprocess.Popen(
            [a.toile, "serve", "--store", store, "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"],
            stdout=subprocess.PIPE, text=True)
        said = {}
        while "fingerprint" not in said:
            key, value = self.server.stdout.readline().split()
            said[key] = value
        self.connect = ["--connect", said["quic"], "--fingerprint", said["fingerprint"]]
        self.threads = [threading.Thread(target=self.play) for _ in range(a.players)]
        for thread in self.threads:
            thread.start()

    def play(self):
        while not self.over:
            subprocess.run([self.a.toile, "play", *self.connect, "--walk", f"clip:{self.clips}", "--frames", "300",
                            "--json"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)

    def leave(self):
        self.over = True
        for thread in self.threads:
            thread.join()
        self.server.terminate()
        self.server.wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scene")
    parser.add_argument("--clips", required=True, help="what players favour at first")
    parser.add_argument("--then", required=True, help="what they favour from --switch seconds on")
    parser.add_argument("--switch", type=float, default=90)
    parser.add_argument("--seconds", type=float, default=240)
    parser.add_argument("--step", type=int, default=100, help="frames of a row")
    parser.add_argument("--players", type=int, default=3)
    parser.add_argument("--vertices")
    parser.add_argument("--policies", default="visited,greedy")
    parser.add_argument("--base", help="an initialised store, with its work folder beside it")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--toile", default="toile")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    explore = [a.toile, "explore", "--scene", a.scene, "--workers", "1", "--json"]
    explore += ["--vertices", a.vertices] if a.vertices else []
    base = a.base or str(a.out / "base")
    first = run(*explore, "--store", base, "--frames", "1")["simulated_frames"]
    print("policy,seconds,frames,seen_mean_mm,seen_p95_mm,merges_per_s,clips", flush=True)
    for policy in a.policies.split(","):
        store = str(a.out / policy)
        for ending in ["", ".work"]:
            shutil.copytree(f"{base}{ending}", f"{store}{ending}", dirs_exist_ok=True)
        players = Players(a, store)
        begun, frames = time.time(), first
        try:
            while (seconds := time.time() - begun) < a.seconds:
                if seconds > a.switch:
                    players.clips = a.then
                found = run(*explore, "--store", store, "--policy", policy, "--frames", str(frames + a.step))
                frames = found["simulated_frames"]
                print(f"{policy},{time.time() - begun:.0f},{frames - first},{found['visited_mean_mm']:.2f},"
                      f"{found['visited_p95_mm']:.1f},{found['visited_merges_per_s']:.3f},"
                      f"{players.clips.replace(',', '+')}", flush=True)
        finally:
            players.leave()


if __name__ == "__main__":
    main()
