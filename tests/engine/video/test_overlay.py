"""The overlay: what is drawn where, what is written, what an interruption leaves."""

from __future__ import annotations

import math
from pathlib import Path

import av
import numpy as np
import pytest

from engine.datatypes import Lift, LiftEnd, Measurement
from engine.errors import Cancelled, DataError, OutputError
from engine.skeletons import MEDIAPIPE_33
from engine.video.overlay import LEFT, RIGHT, OverlayPainter, draw_pose, write_overlay
from engine.video.reader import probe_video, read_frames
from tests.engine.video import clips

NOTHING = Measurement(math.nan)
BODY = {
    "left_shoulder": (200.0, 80.0),
    "left_elbow": (220.0, 120.0),
    "left_wrist": (220.0, 160.0),
    "right_shoulder": (120.0, 80.0),
    "right_elbow": (100.0, 120.0),
    "right_wrist": (100.0, 160.0),
}
FACE = {"nose": (160.0, 50.0), "left_ear": (172.0, 48.0), "right_ear": (148.0, 48.0)}
BOX = (80.0, 20.0, 240.0, 230.0)


def end_at(time_s: float) -> LiftEnd:
    return LiftEnd(time_s, NOTHING, NOTHING, NOTHING)


def lift(start_s: float, end_s: float, **bounds: float) -> Lift:
    return Lift(start_s, end_s, end_at(start_s), end_at(end_s), NOTHING, **bounds)


def place(points: dict[str, tuple[float, float]], scale: float = 1.0) -> np.ndarray:
    array = np.full((33, 2), np.nan)
    for name, xy in points.items():
        array[MEDIAPIPE_33.index(name)] = np.array(xy) * scale
    return array


def has_colour(image: np.ndarray, x: float, y: float, colour, tolerance: int = 40) -> bool:
    patch = image[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3].astype(int)
    return bool((np.abs(patch - colour).max(axis=2) < tolerance).any())


def blank(width: int = 320, height: int = 240) -> np.ndarray:
    return np.full((height, width, 3), 128, np.uint8)


# --- drawing ---------------------------------------------------------------------------------


def test_left_and_right_are_the_subjects_and_differ_in_colour() -> None:
    image = blank()
    draw_pose(image, place(BODY), np.full(33, 0.9), skeleton="mediapipe_33")
    assert has_colour(image, 220, 140, LEFT)
    assert has_colour(image, 100, 140, RIGHT)
    assert not has_colour(image, 220, 140, RIGHT)
    assert has_colour(image, 220, 120, LEFT)
    assert np.array_equal(image[200:], blank()[200:])


@pytest.mark.parametrize("kind", ["protan", "deutan"])
def test_colours_differ_for_colour_blind_people(kind: str) -> None:
    """After Viénot, Brettel and Mollon (1999): what dichromats see of linear RGB."""
    seen = {
        "protan": [[0.11238, 0.88762, 0], [0.11238, 0.88762, 0], [0.00401, -0.00401, 1]],
        "deutan": [[0.29275, 0.70725, 0], [0.29275, 0.70725, 0], [-0.02234, 0.02234, 1]],
    }[kind]
    left, right = (np.array(seen) @ (np.array(c) / 255) ** 2.2 for c in (LEFT, RIGHT))
    assert np.abs(left - right).max() > 0.4


@pytest.mark.parametrize(
    ("confidence", "share"), [(0.9, (0.9, 1.0)), (math.nan, (0.9, 1.0)), (0.35, (0.25, 0.8))]
)
def test_sure_bones_are_solid_and_doubtful_ones_dashed(confidence: float, share) -> None:
    image = blank()
    draw_pose(image, place(BODY), np.full(33, confidence), skeleton="mediapipe_33")
    drawn = [bool(np.abs(image[y, 220].astype(int) - 128).max() > 40) for y in range(126, 155)]
    assert share[0] <= np.mean(drawn) <= share[1]


def test_what_is_hardly_seen_or_missing_is_left_out() -> None:
    image = blank()
    draw_pose(image, place(BODY), np.full(33, 0.1), skeleton="mediapipe_33")
    draw_pose(image, np.full((33, 2), np.nan), np.full(33, 0.9), skeleton="mediapipe_33")
    assert np.array_equal(image, blank())


def test_lines_scale_with_the_picture() -> None:
    def drawn_share(scale: int) -> float:
        image = blank(320 * scale, 240 * scale)
        draw_pose(image, place(BODY, scale), np.full(33, 0.9), skeleton="mediapipe_33")
        return float(np.mean(np.any(image != 128, axis=2)))

    assert drawn_share(4) == pytest.approx(drawn_share(8), rel=0.15)


def test_points_far_outside_do_no_harm() -> None:
    image = blank()
    far = {**BODY, "left_elbow": (1e7, -1e7), "right_elbow": (-1e9, 50.0)}
    draw_pose(image, place(far), np.full(33, 0.9), skeleton="mediapipe_33")
    assert image.shape == (240, 320, 3)


def test_a_smaller_picture_gets_the_same_drawing_smaller() -> None:
    pose = clips.make_pose(BODY, box=BOX)
    small = blank(160, 120)
    OverlayPainter(pose, blur_heads=False).paint(small, 0.5)
    assert has_colour(small, 110, 70, LEFT)
    assert has_colour(small, 50, 70, RIGHT)


def test_heads_are_covered_under_the_drawing() -> None:
    pose = clips.make_pose({**BODY, **FACE}, box=BOX)
    covered, bare = clips.noise_image(320, 240), clips.noise_image(320, 240)
    OverlayPainter(pose).paint(covered, 0.5)
    OverlayPainter(pose, blur_heads=False).paint(bare, 0.5)
    forehead = (slice(30, 38), slice(150, 170))
    assert covered[forehead].std() < 30 < bare[forehead].std()
    assert np.array_equal(covered[105:125, 130:190], bare[105:125, 130:190])


def test_a_picture_between_the_measured_ones_has_no_skeleton_but_covers() -> None:
    pose = clips.make_pose({**BODY, **FACE}, box=BOX)
    image = clips.noise_image(320, 240)
    OverlayPainter(pose).paint(image, 1.2)  # 0.23 s after the last
    assert image[30:38, 150:170].std() < 30
    assert np.array_equal(image[130:150, 90:230], clips.noise_image(320, 240)[130:150, 90:230])


def caption(pose, lifts, time_s: float, **kwargs) -> np.ndarray:
    image = blank(640, 480)
    OverlayPainter(pose, lifts=lifts, **kwargs).paint(image, time_s)
    return image[430:, :320]


def test_the_caption_names_time_and_lift() -> None:
    pose = clips.make_pose(size=(640, 480), n_frames=90)
    lifts = (lift(1.0, 2.0, reach_start_s=0.5, return_end_s=2.5), lift(2.6, 2.9))
    plain = caption(pose, (), 1.5)
    assert (plain != 128).any()
    widths = {
        t: int((caption(pose, lifts, t) != 128).any(axis=(0, 2)).sum())
        for t in (0.2, 0.7, 1.5, 2.2, 2.55, 2.7)
    }
    assert widths[0.2] == widths[2.55] < widths[1.5] == widths[2.7]
    assert widths[1.5] < widths[0.7]
    assert not np.array_equal(caption(pose, lifts, 1.5), caption(pose, lifts, 2.7))
    shifted = caption(pose, lifts, 0.5, time_offset_s=1.0)
    assert np.array_equal(shifted, caption(pose, lifts, 1.5))


# --- the file --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("overlay")
    return clips.counting_clip(folder / "clip.mp4", 30, size=(320, 240), sound=True)


def test_the_file_plays_and_keeps_times(tmp_path: Path, clip: Path) -> None:
    out = tmp_path / "overlay.mp4"
    calls: list[tuple[str, int, int]] = []
    n = write_overlay(
        clip, clips.make_pose(BODY, box=BOX), out, progress=lambda *c: calls.append(c)
    )
    info = probe_video(out)
    assert n == info.n_frames == 30
    assert (info.codec, info.size_px) == ("h264", (320, 240))
    assert np.allclose([f.time_s for f in read_frames(out)], np.arange(30) / 30, atol=1e-4)
    boxes = clips.top_level_boxes(out)
    assert boxes.index("moov") < boxes.index("mdat")
    with av.open(str(out)) as container:
        assert [s.type for s in container.streams] == ["video"]  # voices are not passed on
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p"
    assert calls == [("overlay", i, 30) for i in range(1, 31)]
    assert has_colour(next(read_frames(out)).image, 220, 140, LEFT, tolerance=70)


def test_a_part_is_written(tmp_path: Path, clip: Path) -> None:
    out = tmp_path / "overlay.mp4"
    n = write_overlay(clip, clips.make_pose(BODY), out, start_s=0.2, stop_s=0.5)
    assert n == 9
    assert clips.index_of(next(read_frames(out)).image[:40, :40]) == 6


def test_only_what_was_measured_is_shown(tmp_path: Path, clip: Path) -> None:
    pose = clips.make_pose(BODY, n_frames=12)
    assert write_overlay(clip, pose, tmp_path / "overlay.mp4") == 12
    with pytest.raises(DataError, match="no measured picture"):
        write_overlay(clip, pose, tmp_path / "other.mp4", start_s=0.8)


def test_large_pictures_are_reduced(tmp_path: Path) -> None:
    path = clips.counting_clip(
        tmp_path / "large.mp4", 2, size=(1080, 1920), options={"preset": "ultrafast"}
    )
    pose = clips.make_pose(
        {"left_wrist": (900, 900), "left_elbow": (900, 1500)}, n_frames=2, size=(1080, 1920)
    )
    write_overlay(path, pose, tmp_path / "out.mp4")
    frame = next(read_frames(tmp_path / "out.mp4"))
    assert frame.image.shape == (1280, 720, 3)
    assert has_colour(frame.image, 600, 800, LEFT, tolerance=70)


@pytest.mark.parametrize("stop_at", [1, 29, 30])
def test_cancelling_leaves_nothing(tmp_path: Path, clip: Path, stop_at: int) -> None:
    def cancel(_stage: str, done: int, _total: int) -> None:
        if done == stop_at:
            raise Cancelled

    with pytest.raises(Cancelled):
        write_overlay(clip, clips.make_pose(BODY), tmp_path / "overlay.mp4", progress=cancel)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_an_output_error(tmp_path: Path, clip: Path) -> None:
    with pytest.raises(OutputError):
        write_overlay(clip, clips.make_pose(BODY), tmp_path / "nowhere" / "overlay.mp4")
