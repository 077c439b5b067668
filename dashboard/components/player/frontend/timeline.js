// Lifts, flags and notes along the time axis, as buttons that jump.

import { fill, make, seconds, shape } from "./dom.js";

const MIN_SHARE = 0.012; // a mark of a moment still has to be hit
const WORDS_SHARE = 0.42; // part of the axis that the words of a flag need

/** Part of the axis, 0 to 1. */
function share(data, time) {
  const { first, last } = data;
  return last > first ? Math.min(1, Math.max(0, (time - first) / (last - first))) : 0;
}

function span(data, start, end) {
  const from = share(data, start);
  const to = Math.max(from + MIN_SHARE, share(data, end ?? start));
  return { left: `${100 * Math.min(from, 1 - MIN_SHARE)}%`, width: `${100 * (to - from)}%` };
}

export function liftRow(data, words, jump) {
  const lane = make("div", { class: "lane" });
  for (const lift of data.meta.lifts) {
    const phases = [
      ["reach", lift.reach, lift.start],
      ["return", lift.end, lift.return],
    ];
    for (const [name, from, to] of phases)
      if (from !== null && to !== null && to > from)
        lane.append(
          make("i", { class: `phase ${name}`, title: words[name], style: span(data, from, to) }),
        );
    if (lift.start === null) continue;
    const tip = `${lift.label}: ${seconds(lift.start)} – ${seconds(lift.end ?? lift.start)}`;
    lane.append(
      make(
        "button",
        {
          class: "lift",
          type: "button",
          title: tip,
          "aria-label": `${tip}. ${words.jump}`,
          style: span(data, lift.start, lift.end),
          onclick: () => jump(lift.start),
        },
        make("span", {}, lift.label),
      ),
    );
  }
  if (!data.meta.lifts.length) lane.append(make("span", { class: "quiet" }, words.no_lift));
  return row(words.lifts, lane);
}

/** Flags in as many lanes as they overlap; each knows its number key. */
export function flagRows(data, flags, words, choose) {
  const timed = flags
    .map((flag, index) => ({ flag, index }))
    .filter(({ flag }) => flag.start !== null);
  const lanes = [];
  for (const item of [...timed].sort((a, b) => a.flag.start - b.flag.start)) {
    const from = share(data, item.flag.start);
    const end = share(data, item.flag.end ?? item.flag.start);
    // A flag needs room for its words: to its right or, late in the video, to its left.
    const late = from > 0.68;
    const low = late ? Math.min(from, end - WORDS_SHARE) : from;
    const until = late ? Math.max(end, from) : Math.max(end, from + WORDS_SHARE);
    let lane = lanes.find((one) => one.until <= low + 1e-6);
    if (!lane) lanes.push((lane = { items: [], until: 0 }));
    lane.items.push({ ...item, late, room: late ? end - lane.until : 1 - from });
    const before = lane.items.at(-2);
    if (before && !before.late) before.room = low - share(data, before.flag.start);
    lane.until = until;
  }
  return lanes.map((lane, k) => {
    const field = make("div", { class: "lane" });
    field.append(...lane.items.map((item) => flagBar(data, item, words, choose)));
    return row(k === 0 ? words.flags : "", field);
  });
}

function flagBar(data, { flag, index, late, room }, words, choose) {
  const when = `${seconds(flag.start)} – ${seconds(flag.end ?? flag.start)}`;
  const place = span(data, flag.start, flag.end);
  const width = parseFloat(place.width) / 100;
  return make(
    "div",
    { class: `bar ${flag.css}`, style: place },
    make(
      "button",
      {
        class: `flag ${flag.css}${late ? " late" : ""}`,
        type: "button",
        "data-flag": index,
        style: { maxWidth: `${(100 * room) / width}%` }, // of the bar it sits in
        title: `${flag.word}: ${flag.what} (${when})`,
        "aria-label": `${flag.word}: ${flag.what}, ${when}. ${words.jump}`,
        "aria-pressed": "false",
        onclick: () => choose(index),
      },
      shape(flag.css),
      make("span", { class: "text" }, flagWords(flag)),
    ),
  );
}

function flagWords(flag) {
  return `${flag.word} · ${flag.what}${flag.review ? ` · ${flag.review}` : ""}`;
}

/** Flags about the whole trial have no place on the axis. */
export function wholeFlags(flags, words, choose) {
  const whole = flags
    .map((flag, index) => ({ flag, index }))
    .filter(({ flag }) => flag.start === null);
  if (!whole.length) return null;
  const list = make("div", { class: "whole still" }, make("span", { class: "quiet" }, words.whole_trial));
  for (const { flag, index } of whole)
    list.append(
      make(
        "button",
        {
          class: `flag ${flag.css}`,
          type: "button",
          "data-flag": index,
          "aria-pressed": "false",
          onclick: () => choose(index),
        },
        shape(flag.css),
        make("span", { class: "text" }, flagWords(flag)),
      ),
    );
  return list;
}

export function noteRow(data, notes, words, jump) {
  const timed = notes.filter((note) => note.time !== null);
  if (!timed.length) return null;
  const lane = make("div", { class: "lane notes" });
  for (const note of timed)
    lane.append(
      make("button", {
        class: "note",
        type: "button",
        title: `${seconds(note.time)}: ${note.text}`,
        "aria-label": `${words.note}, ${seconds(note.time)}: ${note.text}. ${words.jump}`,
        style: { left: `${100 * share(data, note.time)}%` },
        onclick: () => jump(note.time),
      }),
    );
  return row(words.notes, lane);
}

function row(title, lane) {
  return make("div", { class: "row" }, make("span", { class: "title" }, title), lane);
}

/** Ticks of the time axis at round seconds. */
export function ruler(data, width, words) {
  const length = data.last - data.first;
  const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300];
  const step = steps.find((size) => (length / size) * 54 <= width) ?? 600;
  const marks = make("div", { class: "ruler-marks", "aria-hidden": "true" });
  for (let k = Math.ceil(data.first / step - 1e-6); k * step <= data.last + 1e-6; k += 1) {
    const text = `${+(k * step).toFixed(1)}`;
    marks.append(make("span", { style: { left: `${100 * share(data, k * step)}%` } }, text));
  }
  return make("div", { class: "row ruler" }, make("span", { class: "title" }, words.time), marks);
}

export function describeFlag(flag, words) {
  const when =
    flag.start === null
      ? words.whole_trial
      : `${seconds(flag.start)} – ${seconds(flag.end ?? flag.start)}`;
  return make(
    "div",
    { class: `detail ${flag.css}` },
    make("div", { class: "chip" }, shape(flag.css), flag.word),
    make(
      "div",
      {},
      make("b", {}, flag.what),
      make("p", {}, flag.why),
      make("p", { class: "quiet" }, [when, flag.review].filter(Boolean).join(" · ")),
    ),
  );
}

export const announceFlag = (flag, words) =>
  fill(words.at_flag, { word: flag.word, what: flag.what });
