"""Drives the page of `toile up` in headless Chromium, as a person would, and measures it.

    python tests/browser/page.py target/release/toile [--pictures FOLDER] [--json FILE]

Needs `playwright` (pip) and Chromium. Prints a line per check, the figures as one JSON object, and last
how many checks passed and failed; leaves with 1 if any failed.
"""

import argparse
import json
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time

from playwright.sync_api import sync_playwright

BENCH = pathlib.Path(__file__).with_name("frame_time.js").read_text()
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


class Up:
    """`toile up` in a folder that is thrown away; the first line of stdout says where the page is."""

    def __init__(self, toile, folder, port=0):
        self.started = time.monotonic()
        self.process = subprocess.Popen(
            [toile, "up", "--scene", "robe", "--store", str(folder / "robe"), "--players", "1",
             "--workers", "1", "--page", f"127.0.0.1:{port}", "--for", "20m"],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.url = self.process.stdout.readline().strip()
        self.port = int(self.url.rstrip("/").rsplit(":", 1)[1])
        threading.Thread(target=self.process.stdout.read, daemon=True).start()

    def end(self):
        self.process.send_signal(signal.SIGINT)
        self.process.wait(60)


class Checks:
    def __init__(self):
        self.passed, self.failed = 0, 0
        self.figures = {}

    def run(self, name, check):
        start = time.monotonic()
        try:
            found = check() or {}
            self.figures.update(found)
            self.passed += 1
            verdict = "ok"
        except Exception as error:  # whatever it is, the other checks still tell something
            self.failed += 1
            verdict = f"FAILED: {str(error).splitlines()[0] if str(error) else repr(error)}"
            found = {}
        print(f"{verdict:7} {name} ({time.monotonic() - start:.1f} s) {json.dumps(found)}", flush=True)


def wait(page, script, seconds, argument=None):
    page.wait_for_function(script, arg=argument, timeout=seconds * 1000, polling=50)


def median(values):
    values = sorted(values)
    return values[len(values) // 2] if values else 0.0


def drawn_on(page, frames=5, seconds=60):
    """Waits until the page has drawn so many frames more."""
    now = page.evaluate("toile.measured.drawn")
    wait(page, "n => toile.measured.drawn > n", seconds, now + frames)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("toile")
    arguments.add_argument("--pictures", type=pathlib.Path)
    arguments.add_argument("--json", type=pathlib.Path)
    arguments.add_argument("--chromium", default=shutil.which("chromium"))
    a = arguments.parse_args()
    checks = Checks()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=a.chromium, args=SOFTWARE)
        drive(checks, a, pathlib.Path(folder), browser)
        browser.close()
    print(json.dumps(checks.figures))
    if a.json:
        a.json.write_text(json.dumps(checks.figures, indent=1) + "\n")
    print(f"{checks.passed} passed, {checks.failed} failed")
    return 1 if checks.failed else 0


def drive(checks, a, folder, browser):
    up = Up(a.toile, folder)
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    # Drawn in software beside an explorer, a frame may take a second.
    page.set_default_timeout(120_000)
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    outside = []
    page.on("request", lambda request: outside.append(request.url)
            if not request.url.startswith((up.url, "data:")) else None)

    def picture(name):
        if a.pictures:
            a.pictures.mkdir(parents=True, exist_ok=True)
            page.screenshot(path=a.pictures / f"{name}.png", timeout=240_000)

    def waits():
        page.goto(up.url)
        wait(page, "() => window.toile && toile.measured.drawn > 3", 60)
        seconds = time.monotonic() - up.started
        assert page.evaluate("toile.measured.versions.length") == 0, "a version so soon"
        wait(page, "() => /Waiting.*frames/.test(document.getElementById('notice').textContent)", 120)
        picture("waiting")
        return {"from_up_to_moving_body_s": round(seconds, 1)}

    def moves():
        wait(page, "() => toile.measured.versions.length > 0", 900)
        drawn_on(page, 3)
        seconds = time.monotonic() - up.started
        drawn_on(page, 10)
        picture("now")
        return {"from_up_to_moving_robe_s": round(seconds, 1)}

    def steers():
        for key, clip in [("2", "run"), ("3", "turn"), ("ArrowUp", "walk"), ("Space", "jump")]:
            before = page.evaluate("(toile.measured.last?.answers?.count) ?? 0")
            page.keyboard.press(key)
            wait(page, "n => toile.measured.last.answers.count > n", 60, before)
            wait(page, "clip => toile.measured.last.clip === clip", 60, clip)
        said = page.inner_text("#answers")
        assert "median" in said, said
        rehearsed = page.evaluate("toile.panels.version.rehearsed")
        return {"answers": rehearsed}

    def sees_a_version():
        first = page.evaluate("toile.measured.versions[0]")
        wait(page, "n => toile.measured.versions.at(-1) > n", 600, first)
        wait(page, "() => document.querySelector('#news p') !== null", 30)
        assert "version" in page.inner_text("#news")

    def tags():
        page.click("[data-tab=merges]")
        page.click("#worst tr:first-child button")
        wait(page, "() => toile.panels.inspected && toile.panels.inspected.merge", 30)
        drawn_on(page, 20)
        picture("merge")
        before = page.evaluate("toile.panels.inspected.worst_mm")
        page.click("#tag")
        wait(page, "() => document.querySelector('#fell.fell') !== null", 600)
        tag = page.evaluate("toile.panels.tags[0]")
        drawn_on(page, 10)
        picture("tagged")
        trail = list((folder / "robe" / "tags").iterdir())
        assert len(trail) == 1, trail
        assert tag["now_mm"] < before, tag
        page.click("#back")
        return {"tag_first_mm": round(before, 1), "tag_now_mm": round(tag["now_mm"], 1),
                "tag_to_improved_merge_s": round(tag["after_s"], 1)}

    def compares():
        page.click("[data-tab=compare]")
        page.click("#compare")
        wait(page, "() => toile.measured.last.characters === 4", 60)
        drawn_on(page, 20)
        assert page.locator("#captions span").count() == 4
        picture("compare")

    def dials():
        full = page.evaluate("toile.measured.last.columns")
        page.evaluate("() => { const d = document.getElementById('dial'); d.value = 80; "
                      "d.dispatchEvent(new Event('input')); }")
        page.click("[data-tab=now]")
        page.evaluate("toile.panels.choose({ do: 'play' })")
        wait(page, "n => toile.measured.last.columns < n", 60, full)
        said = page.inner_text("#dial-cost")
        assert "kB/s" in said and "ms a frame" in said, said
        page.evaluate("() => { const d = document.getElementById('dial'); d.value = 0; "
                      "d.dispatchEvent(new Event('input')); }")

    def crowds():
        found = {}
        # Few pixels: a hundred characters are drawn in software here.
        page.set_viewport_size({"width": 480, "height": 300})
        try:
            page.evaluate("document.querySelector('[data-tab=crowd]').click()")
            for count in (16, 100):
                page.evaluate(f"document.querySelector('[data-crowd=\"{count}\"]').click()")
                wait(page, "n => toile.measured.last.characters === n", 120, count)
                drawn_on(page, 3, 240)
                picture(f"crowd-{count}")
                last = page.evaluate("toile.measured.last")
                found[f"crowd_{count}_decode_us_each"] = round(last["decode_us"])
                found[f"crowd_{count}_all_us_each"] = round(last["write_us"])
                found[f"crowd_{count}_resident_bytes"] = last["resident_bytes"]
        finally:
            page.evaluate("toile.panels.choose({ do: 'play' })")
            page.evaluate("document.querySelector('[data-tab=now]').click()")
            page.set_viewport_size({"width": 1280, "height": 800})
        return found

    def two_at_once():
        other = browser.new_page(viewport={"width": 640, "height": 400})
        other.goto(up.url, timeout=120_000)
        wait(other, "() => window.toile && toile.measured.drawn > 3", 60)
        drawn_on(page)
        # Closed with an answer under way.
        other.evaluate("toile.socket.send('f'); toile.socket.send('f')")
        other.close()
        drawn_on(page)

    def comes_back():
        nonlocal up
        port = up.port
        up.end()
        wait(page, "() => document.getElementById('notice').textContent !== ''", 120)
        up = Up(a.toile, folder, port)
        assert up.port == port
        drawn_on(page, 10, 120)
        least = page.evaluate("() => Math.min(0, ...window.toile.panels.plots.exact.points)")
        assert least >= 0, f"the new line's counts were set off against the old one's: {least}"

    def frame_times():
        found = {}
        for vertices in (3000, 10000, 30000):
            times = page.evaluate(BENCH, vertices)
            found[f"page_frame_ms_{vertices}"] = round(median(times), 1)
        return found

    def asked_nothing():
        assert not outside, outside
        assert not errors, errors

    for name, check in [
            ("the body walks while the robe is simulated", waits), ("a robe moves on the page", moves), ("keys steer it", steers),
            ("a new version announces itself", sees_a_version),
            ("a tagged merge is simulated, and its error falls", tags),
            ("four panes, side by side", compares), ("the dial leaves columns out", dials),
            ("crowds of 16 and 100", crowds), ("two pages, one of them closed in mid frame", two_at_once),
            ("the page comes back after a restart", comes_back),
            ("frame times", frame_times), ("nothing from elsewhere, no error", asked_nothing)]:
        checks.run(name, check)
    up.end()


if __name__ == "__main__":
    sys.exit(main())
