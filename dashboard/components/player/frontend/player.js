// The synchronised player: puts the parts together and handles keys and pointers.

import { Clock, SPEEDS } from "./clock.js";
import { Plot } from "./curves.js";
import { fill, make, seconds } from "./dom.js";
import { FlatPainter } from "./flat.js";
import { applyTheme, borrowFonts, connect, mediaAddress, send } from "./host.js";
import { Orbit } from "./orbit.js";
import * as timeline from "./timeline.js";

const NARROW_PX = 640;
const root = document.getElementById("player");
let player = null;
let sent = Date.now(); // later than any number of an earlier visit of this page

/** Samples as typed arrays of their own memory, so that they are aligned. */
function unpack(args) {
  const bytes = (name) => args[name].slice().buffer;
  const time = new Float32Array(bytes("time"));
  const { meta } = args;
  return {
    meta,
    time,
    first: time[0],
    last: time[time.length - 1],
    nFrames: time.length,
    nPoints: meta.points.length,
    nAngles: meta.groups.reduce((sum, group) => sum + group.curves.length, 0),
    points: new Float32Array(bytes("points")),
    states: new Uint8Array(bytes("states")),
    values: new Float32Array(bytes("values")),
    halves: new Float32Array(bytes("halves")),
    marks: new Uint8Array(bytes("marks")),
  };
}

class Player {
  constructor(args) {
    this.data = unpack(args);
    this.words = args.words;
    this.flags = args.flags;
    this.chosen = -1;
    this.dirty = false;
    this.stats = { draws: 0, draw_ms: 0 };
    this.clock = new Clock(
      this.data.time,
      () => this.#ask(),
      () => this.#showState(),
    );
    this.orbit = new Orbit(this.data.points, this.data.meta.cameras);
    this.shownGroups = new Set(firstGroups(this.data.meta.groups));
    this.#build(args);
    this.#listen();
    this.#startPainter();
  }

  // ------------------------------------------------------------------ building

  #build(args) {
    root.replaceChildren();
    root.setAttribute("aria-label", this.words.title);
    this.stage = make("section", { class: "stage" });
    this.#buildVideos(args.videos);
    this.#buildBody();
    this.controls = this.#buildControls(args.actions);
    this.chips = this.#buildChips();
    this.tracks = make("section", { class: "tracks" });
    this.cursor = make("div", { class: "cursor", "aria-hidden": "true" });
    this.stack = make("div", { class: "stack" });
    this.live = make("div", { class: "unseen", "aria-live": "polite" });
    this.tracks.append(this.stack);
    root.append(this.stage, this.controls, this.tracks, this.live);
    this.update(args);
  }

  #buildVideos(addresses) {
    this.videos = addresses.filter(Boolean).map((address, number) => {
      const video = make("video", {
        src: mediaAddress(address),
        playsinline: true,
        preload: "auto",
        tabindex: -1,
        "aria-label": fill(this.words.video, { n: number + 1 }),
      });
      video.muted = true;
      const frame = make("figure", { class: "view film" }, video);
      if (addresses.length > 1)
        frame.append(make("figcaption", {}, fill(this.words.view, { n: number + 1 })));
      video.addEventListener("click", () => this.clock.toggle());
      video.addEventListener("error", () => this.#loseVideo(video, frame));
      video.addEventListener("loadedmetadata", () => this.#askLayout());
      this.stage.append(frame);
      return video;
    });
    this.stage.dataset.films = this.videos.length;
  }

  #loseVideo(video, frame) {
    this.clock.removeVideo(video);
    frame.replaceChildren(make("p", { class: "sentence" }, this.words.video_lost));
  }

  #buildBody() {
    const { words } = this;
    this.canvas = make("canvas", { tabindex: 0, role: "img", "aria-label": words.body });
    const views = ["oblique", "side", "front", "top"];
    if (this.data.meta.cameras.length) views.push("room");
    const buttons = views.map((view) =>
      button(words[`view_${view}`], () => this.#turn(() => this.orbit.show(view)), "small"),
    );
    const zoom = [
      button("+", () => this.#turn(() => this.orbit.zoom(0.85)), "small", words.nearer),
      button("−", () => this.#turn(() => this.orbit.zoom(1 / 0.85)), "small", words.farther),
    ];
    const legend = make(
      "div",
      { class: "legend" },
      make("span", { class: "left" }, words.left),
      make("span", { class: "right" }, words.right),
      make("span", { class: "doubt" }, words.doubtful),
    );
    this.bodyView = make(
      "figure",
      { class: "view body" },
      make("div", { class: "tools", role: "group", "aria-label": words.views }, ...buttons, ...zoom),
      this.canvas,
      legend,
    );
    this.stage.append(this.bodyView);
  }

  /** Solid figures need a graphics card; computed by the processor they would halt the cursor. */
  async #startPainter() {
    const ability = findGraphics();
    if (ability === "none") this.bodyView.append(make("p", { class: "sentence" }, this.words.no_3d));
    if (ability === "slow") {
      const solid = button(this.words.solid, () => this.#switchPainter(solid), "small");
      solid.setAttribute("aria-pressed", "false");
      solid.title = this.words.solid_help;
      this.bodyView.querySelector(".tools").append(solid);
    }
    await this.#usePainter(ability === "fast" ? "solid" : "flat");
  }

  async #switchPainter(solid) {
    const wanted = solid.getAttribute("aria-pressed") === "true" ? "flat" : "solid";
    await this.#usePainter(wanted);
    const isSolid = document.documentElement.dataset.painter === "SolidPainter";
    solid.setAttribute("aria-pressed", String(isSolid));
  }

  async #usePainter(wanted) {
    if (this.painter) this.#renewCanvas();
    try {
      if (wanted === "flat") throw new Error("not wanted");
      const { SolidPainter } = await import("./solid.js");
      this.painter = new SolidPainter(this.canvas, this.data);
    } catch {
      this.#renewCanvas(); // a canvas keeps the kind of picture it was first asked for
      this.painter = new FlatPainter(this.canvas, this.data);
    }
    document.documentElement.dataset.painter = this.painter.constructor.name;
    this.layout();
  }

  #renewCanvas() {
    this.painter?.dispose();
    this.painter = null;
    const fresh = this.canvas.cloneNode();
    this.canvas.replaceWith(fresh);
    this.canvas = fresh;
    this.#listenToBody();
  }

  #buildControls(actions) {
    const { words, clock } = this;
    this.playButton = button("", () => clock.toggle(), "play");
    this.playButton.append(make("i", { class: "icon", "aria-hidden": "true" }));
    this.readout = make("output", { class: "readout" });
    this.speed = make("select", {
      "aria-label": words.speed,
      title: words.speed,
      onchange: (event) => clock.setSpeed(Number(event.target.value)),
    });
    for (const speed of SPEEDS)
      this.speed.append(make("option", { value: speed }, `${speed}×`));
    this.actions = make("div", { class: "actions" });
    for (const { key, label } of actions)
      this.actions.append(button(label, () => this.#request(key), "quiet-button"));
    const help = make("details", { class: "help" }, make("summary", {}, words.keys));
    const table = make("dl", {});
    for (const [keys, meaning] of words.key_list)
      table.append(make("dt", {}, keys), make("dd", {}, meaning));
    help.append(table);
    this.help = help;
    return make(
      "section",
      { class: "controls", "aria-label": words.controls },
      this.playButton,
      button("‹", () => clock.stepFrames(-1), "step", words.back),
      button("›", () => clock.stepFrames(1), "step", words.forward),
      this.readout,
      this.speed,
      this.actions,
      help,
    );
  }

  #buildChips() {
    const chips = make("div", { class: "chips", role: "group", "aria-label": this.words.joints });
    this.data.meta.groups.forEach((group, k) => {
      const chip = button(group.title, () => this.#toggleGroup(k, chip), "joint");
      chip.setAttribute("aria-pressed", String(this.shownGroups.has(k)));
      chips.append(chip);
    });
    if (!this.data.meta.groups.length)
      chips.append(make("span", { class: "quiet" }, this.words.no_angle));
    return chips;
  }

  #toggleGroup(k, chip) {
    if (!this.shownGroups.delete(k)) this.shownGroups.add(k);
    chip.setAttribute("aria-pressed", String(this.shownGroups.has(k)));
    this.#fillStack();
    this.layout();
  }

  /** Take over what may change while the trial is looked at: flags with reviews, and notes. */
  update({ flags, notes }) {
    const chosen = this.flags[this.chosen]?.key;
    this.flags = flags;
    this.notes = notes;
    this.#fillStack();
    this.#markChosen(flags.findIndex((flag) => flag.key === chosen));
    this.layout();
  }

  #fillStack() {
    const { data, words } = this;
    const jump = (time) => this.#jump(time);
    const choose = (index) => this.chooseFlag(index);
    this.plots = data.meta.groups
      .filter((_, k) => this.shownGroups.has(k))
      .map((group) => new Plot(data, group, words));
    this.rulerPlace = make("div", {
      class: "scrubber",
      role: "slider",
      tabindex: 0,
      "aria-label": words.cursor,
      "aria-valuemin": data.first.toFixed(2),
      "aria-valuemax": data.last.toFixed(2),
    });
    this.detailPlace = make("div", { class: "still" });
    const rows = [
      this.rulerPlace,
      timeline.liftRow(data, words, jump),
      ...timeline.flagRows(data, this.flags, words, choose),
      timeline.noteRow(data, this.notes, words, jump),
      timeline.wholeFlags(this.flags, words, choose),
      this.detailPlace,
      this.chips,
      ...this.plots.map((plot) => plot.element),
      this.cursor,
    ];
    this.stack.replaceChildren(...rows.filter(Boolean));
    this.#markChosen(this.chosen);
  }

  // ------------------------------------------------------------------ pointers and keys

  #listen() {
    for (const video of this.videos) this.clock.addVideo(video);
    this.#listenToBody();
    const scrub = (event) => {
      if (!this.axis) return;
      const x = event.clientX - this.stack.getBoundingClientRect().left;
      this.clock.seek(this.axis.time(x));
    };
    this.stack.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || event.target.closest("button, .still")) return;
      this.stack.setPointerCapture(event.pointerId);
      this.clock.pause();
      this.rulerPlace.focus({ preventScroll: true });
      scrub(event);
      event.preventDefault();
    });
    this.stack.addEventListener("pointermove", (event) => {
      if (this.stack.hasPointerCapture(event.pointerId)) scrub(event);
    });
    this.resizer = new ResizeObserver(() => this.#askLayout());
    this.resizer.observe(this.stage);
  }

  #listenToBody() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (canvas.hasPointerCapture(event.pointerId))
        this.#turn(() => this.orbit.turn(event.movementX, event.movementY));
    });
    canvas.addEventListener("dblclick", () => this.#turn(() => this.orbit.show("oblique")));
    canvas.addEventListener(
      "wheel",
      (event) => {
        // A plain wheel goes on scrolling the page.
        if (!event.ctrlKey && document.activeElement !== canvas) return;
        event.preventDefault();
        this.#turn(() => this.orbit.zoom(Math.exp(event.deltaY / 600)));
      },
      { passive: false },
    );
  }

  onKey(event) {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const inField = /^(SELECT|INPUT|TEXTAREA|SUMMARY)$/.test(event.target.tagName);
    const presses = event.target.tagName === "BUTTON" && /^( |Enter)$/.test(event.key);
    if (inField || presses) return;
    const { clock } = this;
    const frames = event.shiftKey ? 10 : 1;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const doing = {
      " ": () => clock.toggle(),
      k: () => clock.toggle(),
      ArrowLeft: () => clock.stepFrames(-frames),
      ArrowRight: () => clock.stepFrames(frames),
      j: () => clock.changeSpeed(-1),
      l: () => clock.changeSpeed(1),
      ArrowDown: () => clock.changeSpeed(-1),
      ArrowUp: () => clock.changeSpeed(1),
      Home: () => this.#jump(clock.first),
      End: () => this.#jump(clock.last),
      "?": () => (this.help.open = !this.help.open),
    }[key];
    const flag = /^[1-9]$/.test(key) ? Number(key) - 1 : -1;
    if (doing) doing();
    else if (flag >= 0 && flag < this.flags.length) this.chooseFlag(flag);
    else return;
    event.preventDefault();
  }

  #turn(change) {
    change();
    this.#ask();
  }

  #jump(time) {
    this.clock.pause();
    this.clock.seek(time);
    this.live.textContent = this.#place();
  }

  chooseFlag(index) {
    const flag = this.flags[index];
    if (flag.start !== null) this.#jump(flag.start);
    this.#markChosen(index);
    this.live.textContent = timeline.announceFlag(flag, this.words);
    this.#request("flag");
  }

  #markChosen(index) {
    this.chosen = index;
    for (const bar of root.querySelectorAll("[data-flag]"))
      bar.setAttribute("aria-pressed", String(Number(bar.dataset.flag) === index));
    const flag = this.flags[index];
    this.detailPlace.replaceChildren();
    if (flag) this.detailPlace.append(timeline.describeFlag(flag, this.words));
  }

  #request(action) {
    sent += 1;
    send({
      action,
      time_s: this.clock.time,
      flag: this.flags[this.chosen]?.key ?? "",
      number: sent,
    });
  }

  // ------------------------------------------------------------------ drawing

  #askLayout() {
    cancelAnimationFrame(this.layoutAsked);
    this.layoutAsked = requestAnimationFrame(() => this.layout());
  }

  layout() {
    const width = this.stack.clientWidth;
    if (!width) return;
    const narrow = width < NARROW_PX;
    root.classList.toggle("narrow", narrow);
    this.#placeBody(narrow && this.videos.length > 1 ? root : this.stage);
    const left = narrow ? 44 : 76;
    const right = width - 10;
    root.style.setProperty("--gutter", `${left}px`);
    const { first, last } = this.data;
    const scale = (right - left) / (last - first || 1);
    this.axis = {
      width,
      left,
      right,
      x: (time) => left + (time - first) * scale,
      time: (x) => Math.min(last, Math.max(first, first + (x - left) / scale)),
    };
    this.rulerPlace.replaceChildren(timeline.ruler(this.data, right - left, this.words));
    for (const plot of this.plots) plot.draw(this.axis, narrow ? 104 : 120);
    this.#fitBody();
    this.#ask();
  }

  /** Below both videos on a phone, play button and time axis come before the skeleton. */
  #placeBody(place) {
    if (this.bodyView.parentElement !== place) place.append(this.bodyView);
  }

  /** The skeleton is as high as the video beside it. */
  #fitBody() {
    const film = this.stage.querySelector(".film");
    const beside = film && film.offsetTop === this.bodyView.offsetTop;
    const height = beside ? Math.max(200, film.clientHeight) : 300;
    this.canvas.style.height = `${Math.min(height, 460)}px`;
    const { clientWidth, clientHeight } = this.canvas;
    if (clientWidth && clientHeight) this.painter?.resize(clientWidth, clientHeight);
  }

  retheme() {
    this.painter?.retheme();
    this.layout();
  }

  /** Draw once before the next picture, however often the cursor moved. */
  #ask() {
    if (this.dirty) return;
    this.dirty = true;
    requestAnimationFrame(() => {
      this.dirty = false;
      const start = performance.now();
      this.#draw();
      this.stats.draws += 1;
      this.stats.draw_ms += performance.now() - start;
    });
  }

  #draw() {
    const { index, time } = this.clock;
    this.painter?.draw(index, this.orbit);
    if (!this.axis) return;
    this.cursor.style.transform = `translateX(${this.axis.x(time)}px)`;
    for (const plot of this.plots) plot.move(index);
    this.readout.textContent = fill(this.words.readout, {
      time: time.toFixed(2),
      end: this.data.last.toFixed(2),
      frame: index + 1,
      frames: this.data.nFrames,
    });
    this.rulerPlace.setAttribute("aria-valuenow", time.toFixed(2));
    this.rulerPlace.setAttribute("aria-valuetext", this.#place());
  }

  #place() {
    const { time, index } = this.clock;
    const lift = this.data.meta.lifts.find(
      ({ start, end }) => start !== null && time >= start && time <= end,
    );
    const where = lift ? `, ${lift.label}` : "";
    return `${seconds(time)}, ${this.words.frame} ${index + 1}${where}`;
  }

  #showState() {
    const { playing, speed } = this.clock;
    const label = playing ? this.words.pause : this.words.play;
    this.playButton.classList.toggle("playing", playing);
    this.playButton.setAttribute("aria-label", label);
    this.playButton.title = label;
    this.speed.value = String(speed);
  }

  start() {
    this.#showState();
    this.#ask();
  }

  stop() {
    this.clock.stop();
    this.resizer.disconnect();
    this.painter?.dispose();
  }
}

function button(label, onclick, css, name = null) {
  const attributes = { type: "button", class: css, onclick };
  if (name) Object.assign(attributes, { "aria-label": name, title: name });
  return make("button", attributes, label);
}

/** What the browser can do: solid figures at full speed, slowly (without a graphics card), or none. */
function findGraphics() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (!context) return "none";
  // Browsers don't say it by themselves: failIfMajorPerformanceCaveat lets software pass.
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name) ? "slow" : "fast";
}

/** Start with the trunk and the knees: what a lift is judged by first. */
function firstGroups(groups) {
  const wanted = ["Trunk", "Knees"].map((title) => groups.findIndex((g) => g.title === title));
  const there = wanted.filter((k) => k >= 0);
  return there.length || !groups.length ? there : [0];
}

let stamp = null;
let mode = null;

function render(args, theme) {
  applyTheme(theme);
  const now = JSON.stringify(theme);
  if (stamp !== args.stamp) {
    player?.stop();
    stamp = args.stamp;
    player = new Player(args);
    player.start();
    window.liftlensPlayer = player; // for measurements in a browser
  } else {
    player.update(args);
    if (mode !== now) player.retheme();
  }
  mode = now;
}

document.addEventListener("keydown", (event) => player?.onKey(event));
borrowFonts();
connect(render);
