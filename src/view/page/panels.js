
// Panels: what is beside the picture.

const at = id => document.getElementById(id);
const whole = new Intl.NumberFormat("en");
const sized = bytes => (bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e3).toFixed(1)} kB`);
const long = ms => (ms >= 1 ? `${ms.toFixed(1)} ms` : `${(ms * 1000).toFixed(0)} µs`);

function made(name, text, props = {}) {
  const element = Object.assign(document.createElement(name), props);
  if (text !== undefined) element.textContent = text;
  return element;
}

// What may be shown in a pane of a comparison.
const PANE_CHOICES = {
  show: [["the cloth", {}], ["plain skinning", { plain: true }], ["first graph", { version: 1 }],
    ["older version", { older: true }], ["coarse + upsampling", { coarse: true }]],
  columns: [["by dial", {}], ["rank 10", { columns: 10 }], ["rank 50", { columns: 50 }],
    ["full", { columns: 65536 }]],
  blend: [["linear", { blend: "linear" }], ["off", { blend: "off" }], ["smooth", { blend: "smooth" }]],
};
// What a choice is called over its pane.
const PANE_WORDS = { full: "full rank", off: "no blend", smooth: "smooth blend" };
const PANES_AT_FIRST = [[1, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0]];

class Panels {
  constructor(send) {
    this.send = send;
    this.plots = {
      version: new Plot(at("plots"), "version", "#7fb685", v => whole.format(v)),
      shown: new Plot(at("plots"), "error shown now", "#e0a458", v => `${v.toFixed(1)} mm`),
      merge: new Plot(at("plots"), "last merge passed", "#d1495b", v => `${v.toFixed(1)} mm`),
      exact: new Plot(at("plots"), "exact", "#7fb685", v => `${v.toFixed(1)} %`),
      substituted: new Plot(at("plots"), "substituted", "#e0a458", v => `${v.toFixed(1)} %`),
      missed: new Plot(at("plots"), "missed", "#d1495b", v => `${v.toFixed(1)} %`),
      rate: new Plot(at("plots"), "streamed", "#6fa8dc", v => `${v.toFixed(1)} kB/s`),
      resident: new Plot(at("plots"), "resident cloth", "#6fa8dc", v => sized(v)),
      decode: new Plot(at("plots"), "decode", "#b58fd0", v => long(v)),
      page: new Plot(at("plots"), "page, per frame", "#b58fd0", v => long(v)),
    };
    this.timeline = new Timeline(at("timeline"), dead => this.inspect(dead));
    this.version = null;
    this.before = null;
    this.lastMerge = 0;
    this.inspected = null;
    this.tags = [];
    at("tabs").addEventListener("click", event => this.open(event.target.dataset.tab));
    this.open("now");
    this.makePanes();
    for (const button of document.querySelectorAll("[data-crowd]")) {
      button.addEventListener("click", () => {
        const count = Number(button.dataset.crowd);
        this.choose(count === 1 ? { do: "play" } : { do: "crowd", count });
      });
    }
    at("dial").addEventListener("input", () => this.dial());
    at("wind").addEventListener("input", () => this.blow());
    at("speed").addEventListener("input", () => this.pace());
  }

  open(tab) {
    if (!tab) return;
    this.tab = tab;
    for (const button of at("tabs").children) {
      button.setAttribute("aria-selected", String(button.dataset.tab === tab));
    }
    for (const panel of document.querySelectorAll("[data-panel]")) {
      panel.hidden = panel.dataset.panel !== tab;
    }
    for (const plot of Object.values(this.plots)) plot.draw();
  }

  // What is on the stage: asked for again after the line was lost.
  choose(command) {
    this.chosenBefore = this.chosen;
    this.chosen = command;
    if (command.do !== "inspect") this.inspected = null;
    this.send(command);
    this.captions();
    this.drawInspected();
  }

  again() {
    if (this.chosen) this.send(this.chosen);
    this.dial();
    this.blow();
    this.pace();
  }

  // A new line counts from its own beginning.
  forget() {
    this.before = null;
    this.timeline.marks = [];
  }

  // What was on the stage is there still.
  refused(why) {
    this.chosen = this.chosenBefore;
    this.captions();
    this.news(why);
  }

  pace() {
    const times = Number(at("speed").value);
    at("sped").value = times === 1 ? "1" : times.toFixed(2);
    this.send({ do: "speed", times });
  }

  blow() {
    const speed = Number(at("wind").value);
    at("blown").textContent = speed ? `${speed} m/s` : "calm";
    this.send({ do: "wind", m_s: speed });
  }

  inspect(dead) {
    this.open("merges");
    this.choose({ do: "inspect", dead_end: dead });
  }

  takeVersion(said) {
    const before = this.version;
    this.version = said;
    at("subject").textContent = `${said.garment}, ${whole.format(said.vertices)} vertices, version ${said.version}`;
    if (before && said.version > before.version) {
      const change = `worst merge ${before.stats.worst_mm.toFixed(1)} to ${said.stats.worst_mm.toFixed(1)} mm`;
      this.news(`version ${said.version}: ${whole.format(said.states)} states, ${change}`);
    }
    at("passed").textContent = `in the last ${TIMELINE_S} s; ${whole.format(said.merges)} in this version`;
    at("foot").replaceChildren(`${whole.format(said.states)} states over ${said.poses} poses and ${said.edges} edges; `
      + `codec within ${said.stats.codec_max_mm.toFixed(1)} mm. `);
    if (said.server_page) at("foot").append(made("a", "The server's page", { href: said.server_page }));
    this.drawWorst();
    this.dial(false);
  }

  drawWorst() {
    const rows = this.version.worst.map(merge => {
      const row = document.createElement("tr");
      if (this.inspected && this.inspected.dead_end === merge.dead_end) row.className = "chosen";
      row.append(made("td", `${merge.mm.toFixed(1)} mm`), made("td", `${merge.clip} ${merge.frame}`),
        made("td", `${merge.dead_end} to ${merge.target}`));
      const look = made("button", "Look", { title: "Loop the walk around it" });
      look.addEventListener("click", () => this.inspect(merge.dead_end));
      const cell = document.createElement("td");
      cell.append(look);
      row.append(cell);
      return row;
    });
    at("worst").replaceChildren(...rows);
  }

  takeInspected(said) {
    const tag = this.tagOf(said.dead_end);
    this.inspected = said;
    this.timeline.chosen = said.dead_end;
    if (tag && tag.first_mm !== undefined && said.worst_mm < tag.first_mm && said.version !== tag.seen) {
      tag.seen = said.version;
    }
    this.captions();
    this.drawWorst();
    this.drawInspected();
  }

  tagOf(dead) {
    return this.tags.find(tag => tag.dead_end === dead);
  }

  drawInspected() {
    const box = at("inspected");
    const said = this.inspected;
    const tag = said && this.tagOf(said.dead_end);
    // Made anew only where it says something new: whoever presses a button lets go of the same one.
    const says = JSON.stringify([said, tag, this.version && this.version.may_tag]);
    if (says === this.inspectedSays) return;
    this.inspectedSays = says;
    if (!said) {
      box.replaceChildren();
      return;
    }
    const figures = made("div", undefined, { className: "figures" });
    if (said.merge) {
      figures.append(made("b", `${said.merge.mm.toFixed(1)} mm`),
        made("span", `${said.merge.clip} ${said.merge.frame}, version ${said.version}`, { className: "soft" }));
    } else {
      figures.append(made("b", "simulated", { className: "fell" }),
        made("span", `no merge here in version ${said.version}`, { className: "soft" }));
    }
    const parts = [figures, made("p", `Worst merge from here on in this walk: ${said.worst_mm.toFixed(1)} mm`)];
    if (said.merge) parts.push(made("p", "none", { className: "scale", title: "How far the two states are apart" }));
    if (said.merge) parts[parts.length - 1].append(made("i"), `${said.merge.mm.toFixed(0)} mm apart`);
    if (tag) {
      const fell = tag.now_mm < tag.first_mm - 0.05;
      const text = fell
        ? `The error fell from ${tag.first_mm.toFixed(1)} to ${tag.now_mm.toFixed(1)} mm `
          + `${tag.after_s.toFixed(0)} s after the tag`
        : `Tagged at ${tag.first_mm.toFixed(1)} mm; the explorer simulates here next`;
      parts.push(made("p", text, { className: fell ? "fell" : "soft", id: "fell" }));
    }
    const row = made("div", undefined, { className: "row" });
    if (this.version && this.version.may_tag) {
      const button = made("button", tag ? "Tagged" : "Tag it", { id: "tag", disabled: Boolean(tag) || !said.merge });
      button.addEventListener("click", () => this.send({ do: "tag", dead_end: said.dead_end }));
      row.append(button);
    }
    const back = made("button", "Back to the walk", { id: "back" });
    back.addEventListener("click", () => this.choose({ do: "play" }));
    row.append(back);
    box.replaceChildren(...parts, row);
  }

  makePanes() {
    const head = made("div", undefined, { className: "pane soft" });
    head.append(made("span"), made("span", "shows"), made("span", "columns"), made("span", "blend"));
    at("panes").append(head);
    this.panes = PANES_AT_FIRST.map((first, index) => {
      const row = made("div", undefined, { className: "pane" });
      row.append(made("span", String(index + 1), { className: "soft" }));
      const selects = Object.entries(PANE_CHOICES).map(([key, choices], column) => {
        const select = made("select", undefined, { ariaLabel: `${key} of pane ${index + 1}` });
        choices.forEach(([name], value) => select.append(made("option", name, { value })));
        if (column === 0) select.append(made("option", "none", { value: "none" }));
        select.value = String(first[column]);
        row.append(select);
        return select;
      });
      at("panes").append(row);
      return selects;
    });
    at("compare").addEventListener("click", () => this.compare());
  }

  compare() {
    const names = [];
    const panes = [];
    for (const [show, columns, blend] of this.panes) {
      if (show.value === "none") continue;
      const chosen = [[PANE_CHOICES.show, show], [PANE_CHOICES.columns, columns], [PANE_CHOICES.blend, blend]];
      const pane = Object.assign({}, ...chosen.map(([choices, select]) => choices[Number(select.value)][1]));
      const parts = chosen.map(([choices, select]) => choices[Number(select.value)][0]).map(name => PANE_WORDS[name] || name);
      if (pane.older) {
        delete pane.older;
        pane.version = Math.max(1, Math.floor(this.version.version / 2));
        parts[0] = `version ${pane.version}`;
      }
      names.push(parts.filter((part, i) => i === 0 || chosen[i][1].value !== "0").join(", "));
      panes.push(pane);
    }
    if (!panes.length) return;
    this.paneNames = names;
    this.choose({ do: "compare", panes });
  }

  // Names over the panes.
  captions() {
    let names = [];
    if (this.chosen && this.chosen.do === "compare") names = this.paneNames;
    if (this.chosen && this.chosen.do === "inspect" && this.inspected) {
      names = this.inspected.merge ? ["as it is played", "simulated", "goes on as"] : ["as it is played", "simulated", "the same"];
    }
    at("captions").replaceChildren(...names.map((name, index) => {
      const caption = made("span", name);
      caption.style.left = `${(index + 0.5) * 100 / names.length}%`;
      return caption;
    }));
  }

  // The slider is a scale of 0 (all columns), then 0.5 to 300 mm in equal ratios.
  allowed() {
    const value = Number(at("dial").value);
    return value === 0 ? 0 : 0.5 * 600 ** ((value - 1) / 99);
  }

  dial(tell = true) {
    const mm = this.allowed();
    at("dialled").value = mm ? `${mm.toFixed(mm < 10 ? 1 : 0)} mm` : "none";
    if (tell) this.send({ do: "dial", mm });
    const tiers = this.version ? this.version.tiers : null;
    if (!tiers) return;
    at("dial").disabled = !tiers.columns.length;
    if (!tiers.columns.length) {
      at("dial-cost").textContent = "the cloth of this store states no tiers";
      return;
    }
    // Region by region the shortest tier that keeps within the error, over states spread over the poses.
    const last = tiers.columns.length - 1;
    const taken = tiers.stated_mm.map(stated => {
      const found = mm > 0 ? stated.findIndex(error => error <= mm) : -1;
      return found < 0 ? last : found;
    });
    const mean = values => taken.reduce((sum, tier) => sum + values[tier], 0) / taken.length;
    const stated = Math.max(0, ...taken.map((tier, i) => tier < last ? tiers.stated_mm[i][tier] : 0));
    const columns = stated
      ? `${mean(tiers.columns).toFixed(0)} of ${this.version.columns} columns on average, stated error up to ${stated.toFixed(1)} mm`
      : `All ${this.version.columns} columns`;
    at("dial-cost").textContent = `${columns}: ${mean(tiers.decode_ms).toFixed(3)} ms a frame, `
      + `${mean(tiers.read_mb_s).toFixed(0)} MB/s read. New cloth: ${tiers.kb_s.toFixed(1)} kB/s.`;
  }

  takeFigures(said, pageMs) {
    const now = performance.now();
    const before = this.before || { now, ...said };
    const seconds = Math.max((now - before.now) / 1000, 1e-3);
    const steps = ["exact", "substituted", "missed"].map(key => said[key] - before[key]);
    const sum = Math.max(1, steps[0] + steps[1] + steps[2]);
    this.before = { now, ...said };
    const passed = said.passed.filter(mark => mark.mm > 0);
    if (passed.length) this.lastMerge = passed[passed.length - 1].mm;
    this.plots.version.add(said.version);
    this.plots.shown.add(said.shown_mm);
    this.plots.merge.add(this.lastMerge);
    ["exact", "substituted", "missed"].forEach((key, i) => this.plots[key].add(100 * steps[i] / sum));
    const received = said.bytes_received - before.bytes_received;
    this.plots.rate.add(Math.max(0, received) / 1000 / seconds);
    this.plots.resident.add(said.resident_bytes);
    this.plots.decode.add(said.decode_us / 1000);
    this.plots.page.add(pageMs);
    if (said.characters < 4 || !this.chosen || this.chosen.do !== "crowd") {
      this.timeline.add(said.frame, this.version ? this.version.fps : 30, passed);
    }
    this.takeAnswers(said.answers);
    this.takeTags(said.tags || []);
    this.takeCost(said, pageMs);
    this.takeOutside(said.outside);
  }

  // Where the wind has taken the cloth: in the graph, or outside of it.
  takeOutside({ can_leave, frames, nearest_mm, total }) {
    at("wind").disabled = !can_leave;
    const far = nearest_mm === null ? "" : `, nearest state ${nearest_mm.toFixed(0)} mm away`;
    let text = "in the graph" + (total ? `; ${whole.format(total)} frames outside so far` : "");
    if (frames !== null) text = `outside the graph for ${whole.format(frames)} frames${far}`;
    at("outside").textContent = can_leave ? text : "no upsampler in this version: no wind";
  }

  takeAnswers(answers) {
    if (!answers) return;
    const s = value => `${value.toFixed(2)} s`;
    const pressed = answers.count
      ? `Last press: there after ${s(answers.last.arrived_s)}, begun after ${s(answers.last.begun_s)}. `
        + `Of ${answers.count}: median ${s(answers.arrived_median_s)}, 90 % within ${s(answers.arrived_p90_s)}. `
      : "Press a clip's button, its number, an arrow or a gamepad's stick: the walk takes the shortest way there. ";
    const rehearsed = this.version && this.version.rehearsed;
    const known = rehearsed && rehearsed.locomotion.presses
      ? `This graph, over ${rehearsed.all.presses} seeded presses: locomotion median ${s(rehearsed.locomotion.median_s)}, `
        + `90 % within ${s(rehearsed.locomotion.p90_s)}; any clip ${s(rehearsed.all.median_s)} and ${s(rehearsed.all.p90_s)}.` : "";
    at("answers").textContent = pressed + known;
  }

  takeTags(tags) {
    const changed = JSON.stringify(tags) !== JSON.stringify(this.tags);
    if (!changed) return;
    for (const tag of tags) {
      const before = this.tagOf(tag.dead_end);
      if (before && before.now_mm > tag.now_mm + 0.05) {
        this.news(`the tagged merge fell from ${tag.first_mm.toFixed(1)} to ${tag.now_mm.toFixed(1)} mm`);
      }
    }
    this.tags = tags;
    this.drawInspected();
  }

  takeCost(said, pageMs) {
    const rows = [["characters", whole.format(said.characters)], ["decode, each", long(said.decode_us / 1000)],
      ["decode, skin, normals, quantise, each", long(said.write_us / 1000)], ["coefficients resident, all", sized(said.resident_bytes)],
      ["basis, once for all", sized(said.basis_bytes)], ["page, per frame", long(pageMs)],
      ["columns", whole.format(said.columns)]];
    at("cost").replaceChildren(...rows.flatMap(([name, value]) => [made("dt", name), made("dd", value)]));
  }

  news(text) {
    const line = made("p", text);
    at("news").append(line);
    while (at("news").children.length > 4) at("news").firstChild.remove();
    setTimeout(() => line.remove(), 9000);
  }
}
