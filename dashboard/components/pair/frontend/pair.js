"use strict";
// Two videos on one cursor: the reference leads, the attempt follows along the warping.

const [lead, follow] = document.querySelectorAll("video");
const captions = document.querySelectorAll("figcaption");
const play = document.getElementById("play");
const cursor = document.getElementById("cursor");
const clock = document.getElementById("clock");
const speed = document.getElementById("speed");
const phases = document.querySelector(".phases");
let data = null;
let stamp = "";
let timer = 0;

function send(type, content) {
  window.parent.postMessage({ isStreamlitMessage: true, type, ...content }, "*");
}
function fit() {
  send("streamlit:setFrameHeight", { height: Math.ceil(document.body.getBoundingClientRect().height) + 4 });
}

// Linear between the pairs; beyond them the nearest pair holds.
function interpolate(x, from, to) {
  if (x <= from[0]) return to[0];
  let i = 1;
  while (i < from.length - 1 && from[i] < x) i += 1;
  const share = (x - from[i - 1]) / Math.max(from[i] - from[i - 1], 1e-6);
  return to[i - 1] + Math.min(Math.max(share, 0), 1) * (to[i] - to[i - 1]);
}
const first = () => data.reference[0];
const last = () => data.reference[data.reference.length - 1];
const partner = (t) => interpolate(t, data.reference, data.attempt);

function show(t) {
  const share = (t - first()) / (last() - first());
  cursor.value = Math.round(1000 * share);
  clock.textContent = `${t.toFixed(1)} s and ${partner(t).toFixed(1)} s`;
  let current = null;
  for (const button of phases.children) {
    if (Number(button.dataset.at) <= t + 0.02) current = button;
  }
  for (const button of phases.children) {
    button.setAttribute("aria-pressed", String(button === current));
  }
}
function seek(t) {
  const at = Math.min(Math.max(t, first()), last());
  lead.currentTime = at;
  follow.currentTime = partner(at);
  show(at);
}
function stop() {
  lead.pause();
  follow.pause();
  cancelAnimationFrame(timer);
  play.textContent = "Play";
}
function tick() {
  const t = lead.currentTime;
  if (t >= last() - 0.02 || lead.ended) {
    stop();
    seek(last());
    return;
  }
  const wanted = partner(t);
  const apart = wanted - follow.currentTime;
  const slope = (partner(t + 0.1) - wanted) / 0.1;
  // Small leads and lags are run off, large ones jumped over.
  if (Math.abs(apart) > 0.25) follow.currentTime = wanted;
  const rate = Number(speed.value) * (slope + 2 * apart);
  follow.playbackRate = Math.min(Math.max(rate, 0.1), 8);
  show(t);
  timer = requestAnimationFrame(tick);
}
function start() {
  if (lead.currentTime >= last() - 0.05) seek(first());
  lead.playbackRate = Number(speed.value);
  play.textContent = "Pause";
  Promise.all([lead.play(), follow.play()]).then(tick, stop);
}

play.addEventListener("click", () => (lead.paused ? start() : stop()));
speed.addEventListener("change", () => { lead.playbackRate = Number(speed.value); });
cursor.addEventListener("input", () => {
  stop();
  seek(first() + (Number(cursor.value) / 1000) * (last() - first()));
});
document.addEventListener("keydown", (event) => {
  if (!data || ["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName)) return;
  if (event.key === " ") { event.preventDefault(); play.click(); }
  if (event.key === "ArrowRight") seek(lead.currentTime + 1 / 30);
  if (event.key === "ArrowLeft") seek(lead.currentTime - 1 / 30);
});
for (const video of [lead, follow]) {
  video.addEventListener("loadedmetadata", () => { seek(data ? first() : 0); fit(); });
  video.addEventListener("error", () => { clock.textContent = "A video can't be played here."; });
}
window.addEventListener("resize", fit);

// The page's own font, so that the frame reads as a part of it.
function borrowFont() {
  try {
    const rules = [...window.parent.document.styleSheets].flatMap((sheet) => {
      const base = sheet.href || window.parent.location.href;
      return [...sheet.cssRules]
        .filter((rule) => rule.constructor.name === "CSSFontFaceRule")
        .filter((rule) => rule.cssText.includes("Source Sans"))
        .map((rule) => rule.cssText.replace(/url\(["']?([^"')]+)["']?\)/g,
          (_, url) => `url("${new URL(url, base)}")`));
    });
    const style = document.createElement("style");
    style.textContent = rules.join("\n");
    document.head.append(style);
  } catch {
    // Another origin: the system's font does.
  }
}
function paint(theme) {
  if (!theme) return;
  const root = document.documentElement.style;
  const dark = theme.base === "dark";
  root.setProperty("--text", theme.textColor);
  root.setProperty("--panel", theme.secondaryBackgroundColor);
  root.setProperty("--primary", theme.primaryColor);
  root.setProperty("--line", dark ? "rgba(255,255,255,.25)" : "rgba(20,40,60,.25)");
}
function render(args, theme) {
  paint(theme);
  const now = JSON.stringify(args);
  if (now === stamp) return;
  stamp = now;
  data = args;
  stop();
  args.titles.forEach((title, i) => {
    captions[i].textContent = title;
    captions[i].title = title;
    [lead, follow][i].setAttribute("aria-label", title);
  });
  args.videos.forEach((address, i) => {
    const video = [lead, follow][i];
    const url = address ? new URL(address, document.referrer || window.location.origin).href : "";
    if (video.src !== url && url) video.src = url;
  });
  phases.replaceChildren(...args.phases.map((phase) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = phase.name;
    button.dataset.at = phase.at;
    button.addEventListener("click", () => { stop(); seek(phase.at + 0.001); });
    return button;
  }));
  seek(first());
  fit();
}
window.addEventListener("message", (event) => {
  if (event.data.type === "streamlit:render") render(event.data.args, event.data.theme);
});
borrowFont();
send("streamlit:componentReady", { apiVersion: 1 });
fit();
