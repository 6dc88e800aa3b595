// Manual rescue: the same places picked in two clouds, side by side (one at a time on a phone).
import { Vector3 } from "three";
import { h } from "./dom.js";
import { choice } from "./panel.js";
import { fitPairs } from "./pairfit.js";
import { svg } from "./tools.js";

const SIDES = ["source", "target"];
const length = (metres) => (metres < 1 ? `${(1000 * metres).toFixed(metres < 0.0995 ? 1 : 0)} mm` : `${metres.toFixed(2)} m`);

// A place in one of the two clouds: {local, file}, metres about the pane's origin, file coordinates.
export class Rescue extends EventTarget {
  // panes: {source, target}, each {stage, state, tools, say, picture, name, toFile, toLocal}.
  constructor(root, panes, settings, leave) {
    super();
    Object.assign(this, { root, panes, settings, leave, pairs: [], pending: {}, isSaved: true, message: "" });
    for (const side of SIDES) {
      const pane = panes[side];
      pane.tools.add("pair", {
        hint: "",
        pick: (found) => { this.pick(side, found.point); return null; },
        clear: () => {},
        draw: (layer) => this.mark(side, layer),
      });
      pane.tools.choose("pair");
      pane.state.addEventListener("change", () => this.refresh?.());
    }
    for (const { name, source, target } of settings.list ?? []) {
      this.pairs.push({ name, source: this.place("source", source), target: this.place("target", target) });
    }
    this.panel = this.makePanel();
    this.changed(true);
  }

  place(side, file) {
    return { file, local: this.panes[side].toLocal(file) };
  }

  pick(side, local) {
    this.pending[side] = { local, file: this.panes[side].toFile(local) };
    if (this.pending.source && this.pending.target) {
      const used = new Set(this.pairs.map(({ name }) => name));
      let number = this.pairs.length + 1;
      while (used.has(`p${number}`)) number += 1;
      this.pairs.push({ name: `p${number}`, ...this.pending });
      this.pending = {};
    }
    this.changed();
  }

  remove(index) {
    this.pairs.splice(index, 1);
    this.changed();
  }

  undo() {
    if (this.pending.source || this.pending.target) this.pending = {};
    else this.pairs.pop();
    this.changed();
  }

  changed(isSaved = false) {
    this.isSaved = isSaved;
    this.message = "";
    const side = (name) => this.pairs.map((pair) => pair[name].local);
    this.fit = fitPairs(side("source"), side("target"));
    // On a phone only one cloud is to be seen: the one that is waited for.
    this.root.dataset.pane = this.pending.source && !this.pending.target ? "target" : "source";
    for (const name of SIDES) {
      this.panes[name].stage.invalidate();
      this.panes[name].say(this.prompt(name));
    }
    this.refresh();
  }

  prompt(side) {
    const { name } = this.panes[side];
    const other = side === "source" ? "target" : "source";
    if (this.pending[side]) return `${name}: picked; now the same place in ${this.panes[other].name}`;
    if (this.pending[other]) return `${name}: click the same place here`;
    return `${name} (${side}): click a place that the other cloud shows too`;
  }

  mark(side, layer) {
    const dot = (place, words, kind) => {
      const [x, y, z] = this.panes[side].stage.project(place.local);
      if (z < -1 || z > 1) return;
      for (const ring of ["halo", kind]) svg(layer, "circle", { class: ring, cx: x, cy: y, r: 7 });
      svg(layer, "circle", { class: "bull", cx: x, cy: y, r: 1.5 });
      svg(layer, "text", { class: "small", x: x + 11, y: y - 9 }, words);
    };
    this.pairs.forEach((pair, index) => dot(pair[side], pair.name, index === this.fit?.bad ? "ruler bad" : "ruler"));
    if (this.pending[side]) dot(this.pending[side], "?", "ruler pending");
  }

  // Brings a place into the middle of its pane, near enough to see it.
  goTo(index) {
    for (const side of SIDES) {
      const { stage, state } = this.panes[side];
      const eye = stage.camera.position.clone().sub(stage.controls.target).normalize();
      stage.look(new Vector3(...this.pairs[index][side].local), eye, Math.min(stage.halfHeight, 0.12 * stage.scene.radius), stage.isOrtho);
      state.changed();
    }
  }

  // The target's picture shows what the source's shows, by the pose of the pairs so far.
  alike() {
    if (!this.fit) return;
    const { source, target } = this.panes;
    const { camera, controls } = source.stage;
    const eye = camera.position.clone().sub(controls.target).normalize();
    const at = this.fit.move(controls.target.toArray());
    const direction = new Vector3(...this.fit.rotate(eye.toArray()));
    if (Math.abs(eye.z) > 0.99) {
      // From above, the hair by which the view is off the vertical says what is up on the picture.
      const up = new Vector3(...this.fit.rotate(new Vector3().setFromMatrixColumn(camera.matrixWorld, 1).toArray()));
      direction.set(up.x, up.y, 0).normalize().multiplyScalar(-1e-4).add(new Vector3(0, 0, Math.sign(eye.z))).normalize();
    }
    target.stage.look(new Vector3(...at), direction, source.stage.halfHeight, source.stage.isOrtho);
    target.state.view = "";
    target.state.changed();
  }

  document() {
    return { pairs: this.pairs.map(({ name, source, target }) => ({ name, source: source.file, target: target.file })) };
  }

  get csv() {
    const cell = (text) => (/[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
    const rows = this.pairs.map(({ name, source, target }) =>
      [cell(name), cell(this.settings.cloud), ...[...source.file, ...target.file].map((v) => v.toFixed(4)), "", "control"].join(","));
    return `${[this.settings.header, ...rows].join("\n")}\n`;
  }

  async save() {
    try {
      this.message = this.settings.url ? await this.post() : this.download();
      this.isSaved = true;
    } catch (error) {
      this.message = `NOT saved: ${error.message}`;
    }
    this.refresh();
  }

  async post() {
    const answer = await fetch(this.settings.url, {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(this.document()),
    });
    const said = await answer.json().catch(() => ({}));
    if (!answer.ok) throw new Error(said.error ?? `the server answered ${answer.status}`);
    return `${said.pairs} pairs saved in ${said.path}\nNow: ${this.settings.command}`;
  }

  download() {
    const link = h("a", { href: URL.createObjectURL(new Blob([this.csv], { type: "text/csv" })), download: "pairs.csv" });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    return `pairs.csv went to the folder of your downloads\nNow: ${this.settings.command}`;
  }

  verdict() {
    const { fit, pairs } = this;
    if (pairs.length < 3) return `${pairs.length} of at least 3 pairs. Pick them far apart, not on one line.`;
    if (fit.isOnLine) return "The places lie on one line: the turn about it stays free. Pick one well beside it.";
    const size = Math.max(fit.scale, 1 / fit.scale);
    if (size > 1.1) return `Lengths in the two clouds differ ${size.toPrecision(4)} times: other units, or pairs mixed up.`;
    const words = [`${pairs.length} pairs fit to ${length(fit.rms)} (root mean square): how well they were picked, not how well the clouds fit.`];
    if (fit.bad >= 0) words.push(`${pairs[fit.bad].name} does not fit the others: check or remove it.`);
    else if (pairs.length === 3) words.push("A fourth pair would show a bad one.");
    return words.join(" ");
  }

  makePanel() {
    const refreshers = [];
    const button = (words, onclick, more = {}) => h("button", { type: "button", onclick, ...more }, words);
    const each = (act) => (value) => SIDES.forEach((side) => act(this.panes[side].state, value));
    const first = this.panes.source.state;
    const list = h("ol", { class: "pairs" });
    const verdict = h("p", { class: "verdict", role: "status" });
    const message = h("p", { class: "message", role: "status" });
    const save = button(this.settings.url ? "Save" : "Save as CSV", () => this.save(), { class: "save" });
    const undo = button("Undo", () => this.undo()), alike = button("Same view", () => this.alike(), { title: "shows in the target what the source shows" });
    const tabs = choice("Cloud", SIDES.map((side) => this.panes[side].name), () => this.panes[this.root.dataset.pane]?.name,
      (name) => { this.root.dataset.pane = SIDES.find((side) => this.panes[side].name === name); this.refresh(); }, refreshers);
    tabs.classList.add("tabs");
    refreshers.push(() => {
      list.replaceChildren(...this.pairs.map((pair, index) => {
        const isBad = index === this.fit?.bad;
        const off = this.fit ? length(this.fit.residuals[index]) : "–";
        return h("li", { class: isBad ? "bad" : "" },
          h("button", { type: "button", class: "plain", title: "go there", onclick: () => this.goTo(index) }, pair.name),
          h("span", { class: "off" }, off), isBad ? h("span", {}, "does not fit") : null,
          h("button", { type: "button", class: "plain remove", "aria-label": `remove ${pair.name}`, onclick: () => this.remove(index) }, "✕"));
      }));
      verdict.textContent = this.verdict();
      message.textContent = this.message;
      message.hidden = !this.message;
      save.disabled = this.pairs.length < 3;
      undo.disabled = !this.pairs.length && !this.pending.source && !this.pending.target;
      alike.disabled = !this.fit;
    });
    const views = ["iso", "plan", "front", "right", "back", "left"];
    const panel = h("div", { class: "panel" },
      h("div", { class: "group" }, h("h3", {}, "Pick pairs"),
        h("p", {}, "Click the same place in both clouds, three times or more.")),
      tabs,
      h("div", { class: "group" }, h("span", { class: "label" }, "Pairs, and what the best fit leaves of each"), list, verdict,
        h("div", { class: "buttons" }, save, undo, alike, button("Leave", () => this.close())), message),
      choice("Colour", first.colours, () => first.colour, each((state, name) => state.setColour(name)), refreshers),
      choice("View", views, () => first.view, each((state, name) => state.setView(name)), refreshers),
      choice("Thin slice", ["off", "level", "along", "across"], () => first.slice, each((state, name) => state.setSlice(name)), refreshers));
    this.refresh = () => refreshers.forEach((refresher) => refresher());
    return panel;
  }

  close() {
    if (this.isSaved || confirm("The pairs are not saved. Leave all the same?")) this.leave();
  }
}
