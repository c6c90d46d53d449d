
// The page: asks for frames, draws them, and hands on what the player presses.

const FRAME = 2;
const SILENCE_MS = 5000;
const RETRY_MS = [300, 3000];
const STICK_REST = 0.45;

// Words in clip names that the arrows and the space bar stand for.
const ARROWS = {
  ArrowUp: ["walk", "run"], KeyW: ["walk", "run"], ArrowDown: ["backward", "back", "idle", "stand", "walk"],
  KeyS: ["backward", "back", "idle", "stand", "walk"], ArrowLeft: ["left", "turn", "sidestep"],
  KeyA: ["left", "turn", "sidestep"], ArrowRight: ["right", "sidestep", "spin", "whirl"],
  KeyD: ["right", "sidestep", "spin", "whirl"], Space: ["jump", "hop"], ShiftLeft: ["run"],
};

class Page {
  constructor() {
    this.graphics = new Graphics(at("view"));
    this.panels = new Panels(command => this.send(command));
    this.clips = [];
    this.goal = null;
    this.frame = null;
    this.asked = 0;
    this.tries = 0;
    this.pad = "";
    // For whoever measures the page from outside.
    this.measured = { drawn: 0, interval_ms: [], draw_ms: [], versions: [], last: null };
    this.listen();
    this.connect();
    requestAnimationFrame(now => this.show(now));
  }

  connect() {
    const socket = new WebSocket(`ws://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.tries = 0;
      this.asked = 0;
      this.fresh = true;
      this.panels.forget();
      at("notice").textContent = "";
    };
    socket.onmessage = event => this.take(event.data);
    socket.onclose = () => {
      if (this.socket !== socket) return;
      at("notice").textContent = "The line is lost; trying again";
      const wait = Math.min(RETRY_MS[1], RETRY_MS[0] * 2 ** this.tries++);
      setTimeout(() => this.connect(), wait);
    };
    this.socket = socket;
  }

  send(command) {
    if (this.socket && this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(command));
  }

  take(data) {
    if (typeof data !== "string") {
      const kind = new Uint32Array(data, 0, 1)[0];
      if (kind === FRAME) {
        this.asked = 0;
        this.frame = data;
      } else {
        this.graphics.takeMeshes(data);
      }
      return;
    }
    const said = JSON.parse(data);
    switch (said.say) {
      case "waiting":
        this.asked = 0;
        this.waitFor(said);
        break;
      case "version":
        this.takeVersion(said);
        break;
      case "figures":
        this.takeFigures(said);
        break;
      case "inspect":
        this.panels.takeInspected(said);
        break;
      case "refused":
        this.panels.refused(said.why);
        break;
    }
  }

  waitFor(said) {
    if (said.clips.length > 0 && said.clips.join() !== this.clips.join()) this.makeClips(said.clips);
    const skinned = said.clips.length > 0 ? "Shown until then: the garment skinned to the body. " : "";
    at("notice").textContent = said.connected ? `Waiting for the first simulated cloth. ${skinned}${said.exploring}`
      : `Waiting for the server. ${said.error || ""}`;
  }

  takeVersion(said) {
    at("notice").textContent = "";
    this.measured.versions.push(said.version);
    if (said.clips.join() !== this.clips.join()) this.makeClips(said.clips);
    for (const button of at("clips").children) {
      const away = button.dataset.clip !== "" && !said.in_graph[button.dataset.clip];
      button.disabled = away;
      button.title = away ? "no way of the motion graph leads there" : button.title;
    }
    this.panels.takeVersion(said);
    if (this.fresh) {
      // What was on the page before the line was lost.
      this.fresh = false;
      this.panels.again();
      if (this.goal !== null) this.send({ do: "steer", clip: this.goal });
    }
  }

  takeFigures(said) {
    this.measured.last = said;
    const times = this.measured.draw_ms.slice(-30).sort((a, b) => a - b);
    this.panels.takeFigures(said, times[Math.floor(times.length / 2)] || 0);
    for (const button of at("clips").children) {
      const clip = button.dataset.clip;
      button.classList.toggle("playing", said.clip.replace("> ", "") === this.clips[clip]);
      button.setAttribute("aria-pressed", String(clip === "" ? this.goal === null : Number(clip) === this.goal));
    }
  }

  makeClips(clips) {
    this.clips = clips;
    const wander = made("button", "wander", { title: "Escape" });
    wander.dataset.clip = "";
    const buttons = clips.map((clip, index) => {
      const button = made("button", clip);
      if (index < 9) button.prepend(made("kbd", String(index + 1)));
      button.dataset.clip = String(index);
      return button;
    });
    at("clips").replaceChildren(wander, ...buttons);
  }

  steer(clip) {
    this.goal = clip;
    this.send({ do: "steer", clip });
    // Steering means playing: a loop around a merge ends.
    if (this.panels.chosen && this.panels.chosen.do === "inspect") this.panels.choose({ do: "play" });
  }

  steerByWord(words) {
    const found = words.map(word => this.clips.findIndex(clip => clip.includes(word))).find(index => index >= 0);
    if (found !== undefined) this.steer(found);
  }

  listen() {
    at("clips").addEventListener("click", event => {
      const button = event.target.closest("button");
      if (button) this.steer(button.dataset.clip === "" ? null : Number(button.dataset.clip));
      // Whoever clicked goes on with the keys; whoever came here by keys stays.
      if (event.detail) at("view").focus();
    });
    window.addEventListener("keydown", event => {
      if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
      // A slider needs the arrows, a button the space bar, a list everything.
      const on = event.target.tagName;
      if (on === "SELECT" || (on === "INPUT" && event.code.startsWith("Arrow"))) return;
      if (on === "BUTTON" && event.code === "Space") return;
      const digit = /^Digit([1-9])$/.exec(event.code);
      if (digit && Number(digit[1]) <= this.clips.length) this.steer(Number(digit[1]) - 1);
      else if (event.code === "Escape") this.steer(null);
      else if (ARROWS[event.code]) this.steerByWord(ARROWS[event.code]);
      else return;
      event.preventDefault();
    });
    const canvas = at("view");
    canvas.addEventListener("webglcontextlost", event => {
      event.preventDefault();
      at("notice").textContent = "The graphics card was lost; waiting for it";
    });
    canvas.addEventListener("webglcontextrestored", () => location.reload());
    const { orbit } = this.graphics;
    canvas.addEventListener("pointermove", event => {
      if (!(event.buttons & 1)) return;
      orbit.yaw -= event.movementX * 0.008;
      orbit.pitch = Math.max(-0.1, Math.min(1.45, orbit.pitch + event.movementY * 0.006));
    });
    canvas.addEventListener("pointerdown", event => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      orbit.distance = Math.max(1, Math.min(14, orbit.distance * Math.exp(event.deltaY * 0.001)));
    }, { passive: false });
  }

  // Gamepads tell nothing by themselves: the left stick and the buttons are looked at with each frame.
  readPad() {
    const pad = [...(navigator.getGamepads ? navigator.getGamepads() : [])].find(Boolean);
    if (!pad) return;
    const [x, y] = pad.axes;
    // By the standard layout: the first six choose clips, 7 (the right trigger) runs, 12 to 15 are a cross.
    const held = index => Boolean(pad.buttons[index] && pad.buttons[index].pressed);
    const pressed = [0, 1, 2, 3, 4, 5].findIndex(held);
    const cross = ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"].find((_, index) => held(12 + index));
    let said = "";
    if (pressed >= 0 && pressed < this.clips.length) said = `button ${pressed}`;
    else if (cross) said = cross;
    else if (y < -STICK_REST) said = pad.buttons[7] && pad.buttons[7].value > 0.3 ? "ShiftLeft" : "ArrowUp";
    else if (y > STICK_REST) said = "ArrowDown";
    else if (x < -STICK_REST) said = "ArrowLeft";
    else if (x > STICK_REST) said = "ArrowRight";
    if (said && said !== this.pad) {
      if (said.startsWith("button")) this.steer(pressed);
      else this.steerByWord(ARROWS[said]);
    }
    this.pad = said;
  }

  show(now) {
    requestAnimationFrame(next => this.show(next));
    this.readPad();
    if (this.socket.readyState === WebSocket.OPEN) {
      // One frame is asked for at a time: what is slow waits, and nothing piles up.
      if (!this.asked) {
        this.asked = now;
        this.socket.send("f");
      } else if (now - this.asked > SILENCE_MS) {
        this.socket.close();
      }
    }
    if (!this.frame) return;
    const start = performance.now();
    this.graphics.takeFrame(this.frame);
    this.graphics.draw();
    this.frame = null;
    const { measured } = this;
    measured.drawn++;
    measured.draw_ms.push(performance.now() - start);
    if (this.drawnAt) measured.interval_ms.push(start - this.drawnAt);
    this.drawnAt = start;
    for (const list of [measured.draw_ms, measured.interval_ms]) if (list.length > 600) list.splice(0, 300);
  }
}

try {
  window.toile = new Page();
} catch (error) {
  at("notice").textContent = error.message;
}
