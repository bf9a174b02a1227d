# SPDX-License-Identifier: Apache-2.0
"""Videos and image folders: what is found, how frames are numbered, what is said of gaps and damage."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import BackgroundConfig
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.export.recording import open_recording
from limbloc_ros.recordings.batch import save_folder
from limbloc_ros.recordings.folder_source import FolderSource, silhouette
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.recordings.open_source import background_pictures, open_source
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.recordings.videos import ImageFolder, Video, find_streams, read_picture

WIDTH, HEIGHT = 64, 48
DEFAULTS = {"a": BackgroundConfig(), "b": BackgroundConfig()}


def make_rig(*names):
    K = [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]
    return Rig(tuple(Camera(n, WIDTH, HEIGHT, K, np.eye(4)) for n in names), (-1, -1, 0), (1, 1, 2))


def grey(level):
    return np.full((HEIGHT, WIDTH, 3), level, dtype=np.uint8)


def write_folder(folder, levels):
    """One PNG per (number, level)."""
    folder.mkdir(parents=True)
    for number, level in levels:
        cv2.imwrite(str(folder / f"{number:04d}.png"), grey(level))


def write_video(path, levels, fps=50.0):
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for level in levels:
        writer.write(grey(level))
    writer.release()


def levels(stream, numbers=None):
    read = stream.read(stream.numbers if numbers is None else numbers)
    return [(number, round(float(pixels.mean()))) for number, pixels in read]


def test_video_frames_come_in_order(tmp_path):
    write_video(tmp_path / "cam0.avi", [10, 60, 110, 160])
    video = Video(tmp_path / "cam0.avi")
    assert video.fps == pytest.approx(50.0)
    found = levels(video)
    assert [n for n, _ in found] == [0, 1, 2, 3]
    np.testing.assert_allclose([level for _, level in found], [10, 60, 110, 160], atol=2)
    assert [n for n, _ in levels(video, [1, 3])] == [1, 3]
    assert video.notes == []


def test_truncated_video_is_read_as_far_as_it_goes(tmp_path):
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for _ in range(30):
        writer.write(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    writer.release()
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(data[: len(data) // 2])
    video = Video(tmp_path / "a.avi")
    count = len(list(video.read(range(30))))
    assert 5 < count < 30
    assert f"ends after {count} of" in video.notes[0]


def test_a_file_that_is_no_video(tmp_path):
    (tmp_path / "cam0.mp4").write_bytes(b"not a video")
    with pytest.raises(InputError, match=r"cam0\.mp4 cannot be opened as a video"):
        Video(tmp_path / "cam0.mp4")


def test_picture_numbers_are_kept_and_gaps_stay_gaps(tmp_path):
    write_folder(tmp_path / "cam0", [(3, 30), (4, 40), (7, 70)])
    folder = ImageFolder(tmp_path / "cam0")
    assert folder.numbers == [3, 4, 7]
    assert levels(folder, range(3, 9)) == [(3, 30), (4, 40), (7, 70)]


def test_pictures_without_numbers_go_by_name(tmp_path):
    (tmp_path / "cam0").mkdir()
    for name in ("b", "a", "c"):
        cv2.imwrite(str(tmp_path / "cam0" / f"{name}.png"), grey(ord(name)))
    assert levels(ImageFolder(tmp_path / "cam0")) == [(0, ord("a")), (1, ord("b")), (2, ord("c"))]


def test_a_truncated_jpeg_is_left_out_and_named(tmp_path):
    write_folder(tmp_path / "cam0", [(0, 10), (2, 20)])
    cv2.imwrite(str(tmp_path / "cam0" / "0001.jpg"), grey(15))
    data = (tmp_path / "cam0" / "0001.jpg").read_bytes()
    (tmp_path / "cam0" / "0001.jpg").write_bytes(data[:-20])
    folder = ImageFolder(tmp_path / "cam0")
    assert levels(folder) == [(0, 10), (2, 20)]
    assert "0001.jpg" in folder.notes[0]
    assert "truncated" in folder.notes[0]
    with pytest.raises(InputError, match=r"gone\.png cannot be read"):
        read_picture(tmp_path / "gone.png")


def test_streams_are_found_by_camera_name_also_one_folder_below(tmp_path):
    write_video(tmp_path / "rec" / "videos" / "cam0.avi", [10, 20])
    write_folder(tmp_path / "rec" / "videos" / "cam1", [(0, 10), (1, 20)])
    (tmp_path / "rec" / "notes.txt").write_text("")
    for folder in (tmp_path / "rec", tmp_path / "rec" / "videos"):
        streams = find_streams(folder, ("cam0", "cam1"))
        assert [type(s) for s in streams.values()] == [Video, ImageFolder]
    write_folder(tmp_path / "rec" / "masks" / "cam0", [(0, 0)])
    write_folder(tmp_path / "rec" / "masks" / "cam1", [(0, 0)])
    with pytest.raises(InputError, match=r"holds several recordings: give one of .*masks, .*videos as INPUT"):
        find_streams(tmp_path / "rec", ("cam0", "cam1"))
    with pytest.raises(InputError, match=r"no video or image folder of camera left; expected left\.mp4 .* cam0\.avi"):
        find_streams(tmp_path / "rec" / "videos", ("cam0", "left"))
    write_folder(tmp_path / "rec" / "videos" / "cam0", [(0, 10)])
    with pytest.raises(InputError, match="camera cam0 is there more than once"):
        find_streams(tmp_path / "rec" / "videos", ("cam0", "cam1"))


def test_different_frame_rates_are_refused(tmp_path):
    write_video(tmp_path / "a.avi", [1, 2], fps=25)
    write_video(tmp_path / "b.avi", [1, 2], fps=30)
    with pytest.raises(InputError, match=r"different frame rates \(a 25 Hz, b 30 Hz\)"):
        FolderSource(tmp_path, make_rig("a", "b"), DEFAULTS)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        ([[0, 1], [1, 0]], [[0, 255], [255, 0]]),
        ([[0, 255], [3, 250]], [[0, 255], [0, 255]]),  # 3 and 250 are JPEG's ringing
        ([[[0, 0, 0], [0, 200, 0]]], [[0, 255]]),
        ([[0, 0]], [[0, 0]]),
    ],
)
def test_silhouettes_of_any_making(image, expected):
    assert silhouette(np.array(image, dtype=np.uint8)).tolist() == expected


def test_silhouettes_become_masks_and_a_lost_one_is_left_out(tmp_path):
    write_folder(tmp_path / "a", [(0, 255), (1, 255), (2, 0)])
    write_folder(tmp_path / "b", [(0, 0), (2, 255)])
    source = FolderSource(tmp_path, make_rig("a", "b"), DEFAULTS, are_masks=True, fps=10)
    sets = list(source.mask_sets())
    assert [s.stamp_ns for s in sets] == [0, 100_000_000, 200_000_000]
    assert [sorted(s.masks) for s in sets] == [["a", "b"], ["a"], ["a", "b"]]
    assert (sets[0].masks["a"] == 255).all()
    assert (sets[2].masks["a"] == 0).all()
    assert "different numbers of frames" in source.notes[-1]
    again = list(source.mask_sets())
    np.testing.assert_array_equal(again[0].masks["a"], sets[0].masks["a"])


def test_pictures_of_another_size_are_refused(tmp_path):
    (tmp_path / "a").mkdir()
    cv2.imwrite(str(tmp_path / "a" / "0.png"), np.zeros((10, 20), dtype=np.uint8))
    source = FolderSource(tmp_path, make_rig("a"), DEFAULTS, are_masks=True)
    with pytest.raises(InputError, match=r"camera a, .*: expected 64x48 px as in the rig file, got 20x10"):
        list(source.mask_sets())


def textured(seed=0):
    return np.random.default_rng(seed).integers(60, 120, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def write_walk(folder, empty=0, frames=12):
    """A bright square that crosses a textured wall, after some empty frames; returns the empty wall."""
    folder.mkdir(parents=True)
    wall = textured()
    for number in range(empty + frames):
        image = wall.copy()
        if number >= empty:
            x = 4 + 4 * (number - empty)
            image[12:36, x : x + 14] = (40, 220, 240)
        cv2.imwrite(str(folder / f"{number:04d}.png"), image)
    return wall


def square_found(mask, frame):
    x = 4 + 4 * frame
    inside, outside = mask[14:34, x + 2 : x + 12], mask.copy()
    outside[8:40, max(x - 4, 0) : x + 18] = 0
    return (inside > 0).mean() > 0.9 and (outside > 0).mean() < 0.02


def test_the_room_is_learned_from_the_first_frames(tmp_path):
    write_walk(tmp_path / "a", empty=6)
    config = {"a": BackgroundConfig(learning_frames=6, min_blob_px=20)}
    sets = list(FolderSource(tmp_path, make_rig("a"), config).mask_sets())
    assert [bool(s.reason) for s in sets] == [True] * 6 + [False] * 12
    assert sets[2].reason == "learning the background (3 of 6 frames)"
    assert all(square_found(s.masks["a"], i) for i, s in enumerate(sets[6:]))
    assert sets[6].images["a"].shape == (HEIGHT, WIDTH, 3)


def test_somebody_who_moves_while_the_room_is_learned_is_reported_at_once(tmp_path):
    write_walk(tmp_path / "empty" / "a", empty=6)
    write_walk(tmp_path / "full" / "a", empty=0)
    config = {"a": BackgroundConfig(learning_frames=6, min_blob_px=20)}
    calm = FolderSource(tmp_path / "empty", make_rig("a"), config)
    assert list(calm.mask_sets())
    assert calm.notes == []
    assert calm.about["background"] == "learned from the first 6 frames"
    full = FolderSource(tmp_path / "full", make_rig("a"), config)
    sets = full.mask_sets()
    for _ in range(6):
        next(sets)
    (note,) = full.notes  # before the end of the recording
    for words in ("WARNING: camera a", "first 6 frames", "--background estimate"):
        assert words in note


def test_the_room_is_taken_from_a_picture(tmp_path):
    wall = write_walk(tmp_path / "video" / "a")
    (tmp_path / "empty").mkdir()
    cv2.imwrite(str(tmp_path / "empty" / "a.png"), wall)
    rig = make_rig("a")
    pictures = background_pictures(tmp_path / "empty", rig)
    config = {"a": BackgroundConfig(min_blob_px=20)}
    sets = list(FolderSource(tmp_path / "video", rig, config, pictures).mask_sets())
    assert all(square_found(s.masks["a"], i) for i, s in enumerate(sets))


def test_a_run_keeps_all_it_takes_to_read_its_recording_again(tmp_path, monkeypatch):
    wall = write_walk(tmp_path / "video" / "a")
    (tmp_path / "empty").mkdir()
    cv2.imwrite(str(tmp_path / "empty" / "a.png"), wall)
    config = OfflineConfig(background=BackgroundConfig(min_blob_px=20))
    monkeypatch.chdir(tmp_path)  # named from here, found from elsewhere
    source = open_source(Path("video"), make_rig("a"), config, background="empty", fps=50.0)
    about = {**source.about, "config": dataclasses.asdict(config)}
    sets = list(source.mask_sets())
    frames = tuple(FrameResult(s.stamp_ns, NoPerson("not fitted")) for s in sets)
    save_folder(Run(frames, about), source.rig, KeptFrames(), tmp_path / "out")
    monkeypatch.chdir("/")
    run = Run.load(tmp_path / "out")
    again = open_recording(run, tmp_path / "out")
    assert again.identity == source.identity
    for before, after in zip(sets, again.mask_sets(), strict=True):
        assert before.stamp_ns == after.stamp_ns
        np.testing.assert_array_equal(before.masks["a"], after.masks["a"])
    (tmp_path / "empty").rename(tmp_path / "moved")
    with pytest.raises(InputError, match=r"--background .*empty: expected a folder with a picture per camera"):
        open_recording(run, tmp_path / "out")
    assert open_recording(run, tmp_path / "out", background=str(tmp_path / "moved")).identity == source.identity


def test_the_room_is_guessed_from_a_recording_with_somebody_in_it(tmp_path):
    write_walk(tmp_path / "a")
    config = {"a": BackgroundConfig(min_blob_px=20)}
    sets = list(FolderSource(tmp_path, make_rig("a"), config, estimate=True).mask_sets())
    assert all(square_found(s.masks["a"], i) for i, s in enumerate(sets))


def test_background_pictures_that_are_missing_or_do_not_fit(tmp_path):
    rig = make_rig("a", "b")
    with pytest.raises(InputError, match="expected a folder with a picture per camera, or the word estimate"):
        background_pictures(tmp_path / "nowhere", rig)
    cv2.imwrite(str(tmp_path / "a.png"), grey(3))
    with pytest.raises(InputError, match=r"no picture of camera b; expected files such as b\.png, found a\.png"):
        background_pictures(tmp_path, rig)
    cv2.imwrite(str(tmp_path / "b.jpg"), np.zeros((10, 10), dtype=np.uint8))
    with pytest.raises(InputError, match=r"camera b, .*b\.jpg: expected 64x48 px"):
        background_pictures(tmp_path, rig)
