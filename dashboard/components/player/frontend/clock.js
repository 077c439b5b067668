// The one time cursor. It moves by the pictures of the first video where there is one, otherwise by
// the clock; everything else follows it.

export const SPEEDS = [0.25, 0.5, 1, 1.5, 2];
const DRIFT_S = 0.06; // the second video may be off by this much before it is put right

export class Clock {
  constructor(times, onMove, onState) {
    this.times = times;
    this.first = times[0];
    this.last = times[times.length - 1];
    this.step = times.length > 1 ? (this.last - this.first) / (times.length - 1) : 1 / 30;
    this.onMove = onMove;
    this.onState = onState;
    this.videos = [];
    this.time = this.first;
    this.index = 0;
    this.playing = false;
    this.speed = 1;
    this.alive = true;
    this.wanted = new Map(); // where a video that is still seeking should go next
  }

  addVideo(video) {
    this.videos.push(video);
    video.addEventListener("seeked", () => this.#seekAgain(video));
    video.addEventListener("ended", () => this.playing && video === this.videos[0] && this.#end());
    video.addEventListener("pause", () => {
      // The browser stops videos of hidden pages, or when headphones are pulled.
      if (this.playing && video === this.videos[0] && !video.ended) this.pause();
    });
    if (this.videos.length === 1 && video.requestVideoFrameCallback) this.#watch(video);
    this.#seekVideo(video);
  }

  removeVideo(video) {
    this.videos = this.videos.filter((other) => other !== video);
  }

  /** Shown pictures say exactly where the video is; its currentTime runs ahead of them. */
  #watch(video) {
    const shown = (_, picture) => {
      if (!this.alive) return;
      if (this.playing && video === this.videos[0]) this.#place(this.first + picture.mediaTime);
      video.requestVideoFrameCallback(shown);
    };
    video.requestVideoFrameCallback(shown);
  }

  #place(time) {
    this.time = Math.min(Math.max(time, this.first), this.last);
    const index = nearest(this.times, this.time);
    this.index = index;
    this.onMove();
  }

  seek(time) {
    if (!Number.isFinite(time)) return;
    this.#place(time);
    this.time = this.times[this.index];
    for (const video of this.videos) this.#seekVideo(video);
    this.onMove();
  }

  stepFrames(count) {
    this.pause();
    const index = Math.min(Math.max(this.index + count, 0), this.times.length - 1);
    this.seek(this.times[index]);
  }

  #target() {
    // A quarter of a picture later: rounded time stamps must not show the one before.
    return Math.max(0, this.time - this.first) + 0.25 * this.step;
  }

  #seekVideo(video) {
    if (video.readyState === 0) {
      video.addEventListener("loadedmetadata", () => this.#seekVideo(video), { once: true });
      return;
    }
    const target = Math.min(this.#target(), video.duration || Infinity);
    if (video.seeking) this.wanted.set(video, target);
    else if (Math.abs(video.currentTime - target) > 1e-4) video.currentTime = target;
  }

  #seekAgain(video) {
    const target = this.wanted.get(video);
    this.wanted.delete(video);
    if (target !== undefined && Math.abs(video.currentTime - target) > 1e-4)
      video.currentTime = target;
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  play() {
    if (this.playing) return;
    if (this.index >= this.times.length - 1) this.seek(this.first);
    this.playing = true;
    for (const video of this.videos) this.#start(video);
    this.onState();
    let before = performance.now();
    const tick = (now) => {
      if (!this.playing || !this.alive) return;
      this.#advance((now - before) / 1000);
      before = now;
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  /** A video that is still on its way to a picture starts there, not where it comes from. */
  #start(video) {
    if (!this.playing) return;
    if (video.seeking || this.wanted.has(video)) {
      video.addEventListener("seeked", () => this.#start(video), { once: true });
      return;
    }
    video.playbackRate = this.speed;
    video.play().catch(() => video === this.videos[0] && this.pause());
  }

  #advance(passed) {
    const [leader, ...others] = this.videos;
    if (!leader) {
      this.#place(this.time + passed * this.speed);
    } else {
      if (!leader.requestVideoFrameCallback) this.#place(this.first + leader.currentTime);
      for (const video of others)
        if (Math.abs(video.currentTime - leader.currentTime) > DRIFT_S && !video.seeking)
          video.currentTime = leader.currentTime;
    }
    if (this.time >= this.last - 1e-6) this.#end();
  }

  #end() {
    this.pause();
    this.seek(this.last);
  }

  pause() {
    if (!this.playing) return;
    this.playing = false;
    for (const video of this.videos) video.pause();
    this.seek(this.time);
    this.onState();
  }

  setSpeed(speed) {
    this.speed = speed;
    for (const video of this.videos) video.playbackRate = speed;
    this.onState();
  }

  changeSpeed(by) {
    const at = SPEEDS.indexOf(this.speed) + by;
    this.setSpeed(SPEEDS[Math.min(Math.max(at, 0), SPEEDS.length - 1)]);
  }

  stop() {
    this.pause();
    this.alive = false;
  }
}

/** Index of the sample nearest to a time. */
export function nearest(times, time) {
  let low = 0;
  let high = times.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle;
  }
  return time - times[low] <= times[high] - time ? low : high;
}
