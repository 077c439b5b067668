"""The sound of a video, and the lag between two sounds of one scene.

Two microphones hear the same knocks and voices, through other rooms and at other loudness. What
they share best is WHEN something starts in each band of pitch, so onsets are correlated; the peak
between two hops of 10 ms tells the lag within some ms. (The whitened phase of the sounds was tried
as a finer step: the echoes of two rooms made the lag worse.) Sound needs 3 ms per metre, so a lag
is never surer than the unknown distances to the source.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import av
import av.error
import numpy as np
from av.audio.frame import AudioFrame
from av.audio.resampler import AudioResampler
from av.container import InputContainer
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import gaussian_filter1d

from engine.datatypes import Array
from engine.errors import DataError
from engine.video.reader import OPEN_OPTIONS

__all__ = ["AudioLag", "AudioTrack", "estimate_audio_lag", "read_audio"]

logger = logging.getLogger(__name__)

RATE_HZ: Final = 8000
HOP: Final = 80
HOP_S: Final = HOP / RATE_HZ
FRAME: Final = 256
BANDS_HZ: Final = (100.0, 250.0, 450.0, 750.0, 1200.0, 1900.0, 2800.0, 3900.0)
SILENCE: Final = 1e-4
"""Root mean square of full scale (-80 dB) below which there is nothing to hear."""
MAX_LENGTH_S: Final = 3600.0
MIN_OVERLAP_S: Final = 1.0
EXCERPT_S: Final = 60.0
"""Longer recordings are matched piece by piece: clocks that drift smear a longer correlation."""
N_EXCERPTS: Final = 4
PEAK_DISTANCE_S: Final = 0.15
PATH_SIGMA_S: Final = 0.005
"""From sound paths that differ by 1.7 m (standard error): cameras stand at unlike distances."""
ONSET_SIGMA_S: Final = 0.003
CHANCE_PEAK: Final = 7.0
SURE_PEAK: Final = 14.0
"""Peaks in units of the correlation's own scatter: the largest by chance, and one beyond doubt."""


@dataclass(frozen=True, eq=False)
class AudioTrack:
    """Sound of one video: mono samples from -1 to 1.

    `start_s` is the time of the first sample after the first picture of the video.
    """

    samples: NDArray[np.float32]
    rate_hz: int = RATE_HZ
    start_s: float = 0.0

    def __post_init__(self) -> None:
        samples = np.array(self.samples, dtype=np.float32, copy=True)
        if samples.ndim != 1 or self.rate_hz != RATE_HZ:
            raise DataError(
                f"Sound needs one channel at {RATE_HZ} Hz, got shape {samples.shape} at "
                f"{self.rate_hz} Hz. Read it with read_audio."
            )
        samples.setflags(write=False)
        object.__setattr__(self, "samples", samples)


@dataclass(frozen=True)
class AudioLag:
    """Seconds to add to times of the second video, with standard error and confidence (0 to 1)."""

    offset_s: float
    sigma_s: float
    confidence: float
    drift: float = 0.0


def read_audio(path: Path) -> AudioTrack | None:
    """Read the sound of a video.

    Parameters
    ----------
    path
        The video file.

    Returns
    -------
    AudioTrack or None
        None where the file has no sound, only silence, or none that can be decoded: sound is a
        help, never a need. At most the first hour is read.
    """
    path = Path(path)
    try:
        with av.open(f"file:{path}", mode="r", options=dict(OPEN_OPTIONS)) as container:
            if not container.streams.audio:
                return None
            picture_s = _first_picture_s(container)
            track = _decode(container, picture_s)
    except (av.error.FFmpegError, OSError) as error:
        logger.warning("The sound of %s can't be read (%s); it is left out.", path.name, error)
        return None
    if track is None or float(np.sqrt(np.mean(np.square(track.samples)))) < SILENCE:
        return None
    return track


def _first_picture_s(container: InputContainer) -> float:
    """Return when the first picture is shown, on the file's clock."""
    for stream in container.streams.video:
        if stream.start_time is not None and stream.time_base is not None:
            return float(stream.start_time * stream.time_base)
    return 0.0


def _decode(container: InputContainer, picture_s: float) -> AudioTrack | None:
    """Put every decoded piece where its time stamp says; holes are silent."""
    resampler = AudioResampler(format="flt", layout="mono", rate=RATE_HZ)
    pieces: list[tuple[float, NDArray[np.float32]]] = []
    try:
        for frame in container.decode(audio=0):
            if frame.time is not None and frame.time - picture_s > MAX_LENGTH_S:
                break
            pieces += [_piece(out, picture_s) for out in resampler.resample(frame)]
        pieces += [_piece(out, picture_s) for out in resampler.resample(None)]
    except av.error.FFmpegError as error:
        # A file that was cut off still has the sound up to there.
        logger.warning("The sound ends too early: %s.", error.strerror)
    pieces = [piece for piece in pieces if len(piece[1])]
    if not pieces:
        return None
    start_s = pieces[0][0]
    length = max(round((at - start_s) * RATE_HZ) + len(values) for at, values in pieces)
    samples = np.zeros(length, dtype=np.float32)
    for at, values in pieces:
        begin = max(0, round((at - start_s) * RATE_HZ))
        samples[begin : begin + len(values)] = values[: length - begin]
    return AudioTrack(np.nan_to_num(samples), start_s=start_s)


def _piece(frame: AudioFrame, picture_s: float) -> tuple[float, NDArray[np.float32]]:
    time_s = 0.0 if frame.time is None else float(frame.time)
    return time_s - picture_s, np.asarray(frame.to_ndarray(), dtype=np.float32).reshape(-1)


def estimate_audio_lag(first: AudioTrack | None, second: AudioTrack | None) -> AudioLag | None:
    """Find the lag between two sounds of one scene.

    Parameters
    ----------
    first, second
        Sound of both videos, None where there is none.

    Returns
    -------
    AudioLag or None
        None without two sounds of at least a second. A low confidence means: do not use.

    Notes
    -----
    Onsets are correlated at every lag, normalised by the overlap. The confidence follows from the
    highest peak against the scatter of all others, and against the second peak: hammering in
    time fits at many lags.
    """
    if first is None or second is None:
        return None
    onsets = compute_onsets(first), compute_onsets(second)
    if min(len(onset) for onset in onsets) * HOP_S < MIN_OVERLAP_S:
        return None
    found = [_match(onsets[0], onsets[1][begin:end], begin) for begin, end in _excerpts(onsets[1])]
    lag, confidence = max(found, key=lambda match: match[1])
    start_s = first.start_s - second.start_s
    drift, lag_s = _follow(onsets, lag * HOP_S)
    return AudioLag(
        offset_s=lag_s + start_s - drift * second.start_s,
        sigma_s=math.hypot(ONSET_SIGMA_S, PATH_SIGMA_S),
        confidence=confidence,
        drift=drift,
    )


def compute_onsets(track: AudioTrack) -> Array:
    """Return how much louder each band gets from one hop to the next, shape (T, bands).

    Each band has mean 0 and spread 1, so that loudness and the colour of a room drop out.
    """
    n_hops = max(0, (len(track.samples) - FRAME) // HOP + 1)
    if n_hops < 3:
        return np.zeros((0, len(BANDS_HZ) - 1))
    frames = np.lib.stride_tricks.sliding_window_view(track.samples, FRAME)[::HOP]
    window = np.hanning(FRAME).astype(np.float32)
    edges = np.searchsorted(np.fft.rfftfreq(FRAME, 1.0 / RATE_HZ), BANDS_HZ)
    blocks = []
    for begin in range(0, len(frames), 8192):  # bounds the memory for an hour of sound
        power = np.abs(rfft(frames[begin : begin + 8192] * window, axis=1)) ** 2
        blocks.append(np.add.reduceat(power, edges[:-1], axis=1))
    energy = np.concatenate(blocks).astype(np.float64)
    # Relative to the band's own noise: steps of what can't be heard count nothing.
    level = np.log(energy + np.percentile(energy, 20.0, axis=0) + 1e-9)
    rise = np.maximum(np.diff(gaussian_filter1d(level, 1.0, axis=0), axis=0), 0.0)
    rise -= rise.mean(axis=0)
    return np.asarray(rise / np.maximum(rise.std(axis=0), 1e-6))


def _excerpts(onsets: Array) -> list[tuple[int, int]]:
    length, piece = len(onsets), round(EXCERPT_S / HOP_S)
    if length <= 2 * piece:
        return [(0, length)]
    begins = np.linspace(0, length - piece, N_EXCERPTS).astype(int)
    return [(int(begin), int(begin) + piece) for begin in begins]


def _match(first: Array, second: Array, begin: int) -> tuple[float, float]:
    """Return the best lag of an excerpt that begins at hop `begin`, in hops, and its confidence."""
    least = min(round(MIN_OVERLAP_S / HOP_S), len(second) // 2, len(first) // 2)
    lags = np.arange(least - len(second), len(first) - least + 1)
    length = next_fast_len(len(first) + len(second), real=True)
    product = np.sum(rfft(first, length, axis=0) * np.conj(rfft(second, length, axis=0)), axis=1)
    overlap = np.minimum(lags + len(second), len(first)) - np.maximum(lags, 0)
    # Of independent onsets the sum over the overlap scatters with the overlap's root; the added
    # share keeps one knock in a short overlap from counting like many in a long one.
    score = irfft(product, length)[lags] / np.sqrt(overlap + 0.5 * min(len(first), len(second)))
    score = gaussian_filter1d(score, 1.0)
    score -= np.median(score)
    scatter = 1.4826 * float(np.median(np.abs(score))) + 1e-12
    best = int(np.argmax(score))
    distance = round(PEAK_DISTANCE_S / HOP_S)
    others = np.concatenate([score[: max(0, best - distance)], score[best + distance + 1 :]])
    rival = float(others.max(initial=0.0)) / float(score[best])
    peak = float(score[best]) / scatter
    certain = np.clip((peak - CHANCE_PEAK) / (SURE_PEAK - CHANCE_PEAK), 0.0, 1.0)
    single = np.clip((0.75 - rival) / 0.25, 0.0, 1.0)
    shift = _parabola(score, best)
    return float(lags[best]) + shift - begin, float(certain * single)


def _parabola(score: Array, best: int) -> float:
    if not 0 < best < len(score) - 1:
        return 0.0
    before, peak, after = score[best - 1 : best + 2]
    bend = before - 2.0 * peak + after
    return float(0.5 * (before - after) / bend) if bend < 0.0 else 0.0


def _follow(onsets: tuple[Array, Array], lag_s: float) -> tuple[float, float]:
    """Return drift and lag (at the start of the second) from pieces of long recordings."""
    first, second = onsets
    piece, reach = round(20.0 / HOP_S), round(0.3 / HOP_S)
    lag = round(lag_s / HOP_S)
    begins = [b for b in range(0, len(second) - piece, piece) if b + lag >= reach]
    begins = [b for b in begins if b + lag + piece + reach <= len(first)]
    if len(begins) < 4:
        return 0.0, lag_s
    times, lags = [], []
    for begin in begins:
        wide = first[begin + lag - reach : begin + lag + piece + reach]
        score = np.array(
            [np.sum(wide[k : k + piece] * second[begin : begin + piece]) for k in range(2 * reach)]
        )
        best = int(np.argmax(score))
        if score[best] > 5.0 * 1.4826 * np.median(np.abs(score - np.median(score))):
            times.append((begin + piece / 2) * HOP_S)
            lags.append((lag - reach + best + _parabola(score, best)) * HOP_S)
    return _fit_clock(np.array(times), np.array(lags)) if len(times) >= 4 else (0.0, lag_s)


def _fit_clock(times: Array, lags: Array) -> tuple[float, float]:
    """Fit a line through the lags, robustly (median of slopes)."""
    i, j = np.triu_indices(len(times), k=1)
    slope = float(np.median((lags[j] - lags[i]) / (times[j] - times[i])))
    left = lags - slope * times
    error = 1.4826 * float(np.median(np.abs(left - np.median(left))))
    span = float(np.ptp(times)) * math.sqrt(len(times) / 12.0)
    if abs(slope) < 4.0 * max(error, 0.001) / span:
        return 0.0, float(np.median(lags))
    return slope, float(np.median(left))
