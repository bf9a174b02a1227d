# SPDX-License-Identifier: Apache-2.0
"""Segmentation of rooms: people, shadows, lamps, moved and covered cameras, seeds, bad input, a rendered walk."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from background_rooms import HEIGHT, PERSON, WIDTH, iou, learned, noisy, room, textured
from hypothesis import given, settings
from hypothesis import strategies as st

from limbloc_ros.core.background import MOVED_PATIENCE, PATIENCE, BackgroundModel
from limbloc_ros.core.background_estimate import estimate_background
from limbloc_ros.core.config import BackgroundConfig
from limbloc_ros.core.errors import ConfigError, InputError

WALK = Path(__file__).parent / "data" / "rgb_walk"


class TestScenes:
    def test_an_empty_room_gives_an_empty_mask(self):
        rng = np.random.default_rng(0)
        model = learned(rng, noise=2.5)
        for _ in range(30):
            result = model.segment(room(rng, noise=2.5))
            assert not result.learning
            assert not result.mask.any()
            assert result.foreground_fraction == 0

    def test_the_mask_is_empty_while_learning(self):
        rng = np.random.default_rng(0)
        model = BackgroundModel(BackgroundConfig(learning_frames=3))
        for n in range(3):
            image = room(rng)
            image[PERSON] = (20, 200, 20)
            result = model.segment(image)
            assert result.learning
            assert result.frames_learned == n + 1
            assert not result.mask.any()
        assert not model.learning

    def test_a_person_is_found_where_he_stands(self):
        rng = np.random.default_rng(1)
        model = learned(rng)
        image = room(rng)
        image[PERSON] = (30, 160, 60)
        truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
        truth[PERSON] = True
        mask = model.segment(image).mask
        assert mask.dtype == np.uint8
        assert set(np.unique(mask)) == {0, 255}
        assert iou(mask > 0, truth) > 0.98

    def test_the_blur_of_the_lens_does_not_move_the_outline(self):
        rng = np.random.default_rng(1)
        model = learned(rng)
        sharp = room(rng, noise=0).astype(np.float32)
        sharp[PERSON] = (30, 160, 60)
        image = cv2.GaussianBlur(sharp, (0, 0), 1.2) + rng.normal(0, 1, sharp.shape)
        truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
        truth[PERSON] = True
        mask = model.segment(np.clip(image, 0, 255).astype(np.uint8)).mask > 0
        assert abs(np.count_nonzero(mask) / np.count_nonzero(truth) - 1) < 0.05

    @given(st.floats(0.56, 0.97), st.integers(0, 3))
    @settings(max_examples=12, deadline=None)
    def test_a_cast_shadow_vanishes_and_the_person_stays(self, factor, seed):
        rng = np.random.default_rng(seed)
        model = learned(rng)
        light = np.ones((HEIGHT, WIDTH, 1), dtype=np.float32)
        light[60:80, 60:120] = factor
        image = room(rng, noise=0) * cv2.GaussianBlur(light, (0, 0), 2)[..., None]
        image += rng.normal(0, 1, image.shape)
        image[PERSON] = (30, 160, 60)
        truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
        truth[PERSON] = True
        mask = model.segment(np.clip(np.rint(image), 0, 255).astype(np.uint8)).mask > 0
        assert iou(mask, truth) > 0.97

    def test_who_stands_still_is_not_absorbed(self):
        rng = np.random.default_rng(2)
        model = learned(rng, BackgroundConfig(learning_rate=0.05))
        image = room(rng)
        image[PERSON] = (30, 160, 60)
        first = model.segment(image).foreground_fraction
        for _ in range(150):
            result = model.segment(image)
        assert result.foreground_fraction == pytest.approx(first, rel=0.02)

    def test_a_faint_rim_around_a_person_is_not_learned(self):
        rng = np.random.default_rng(2)
        model = learned(rng, BackgroundConfig(learning_rate=0.05))
        image = room(rng, noise=0)
        image[28:72, 48:72] += 6  # below the threshold
        image[PERSON] = (30, 160, 60)
        before = model.background
        for _ in range(100):
            model.segment(image)
        rim = (slice(28, 30), slice(50, 70))
        assert np.abs(model.background[rim].astype(int) - before[rim]).max() <= 1

    def test_light_that_drifts_while_learning_is_no_noise(self):
        rng = np.random.default_rng(2)
        model = BackgroundModel()
        for light in np.linspace(1.1, 0.9, 15):
            model.segment(room(rng, light=light))
        image = room(rng, light=0.9).astype(int)
        image[PERSON] += (20, -20, 0)
        assert np.count_nonzero(model.segment(image.astype(np.uint8)).mask[PERSON]) > 0.95 * 800

    def test_a_shadow_is_not_learned(self):
        rng = np.random.default_rng(2)
        model = learned(rng, BackgroundConfig(learning_rate=0.05))
        shaded = room(rng)
        shaded[20:60, 20:60] = shaded[20:60, 20:60] * 0.7
        before = model.background
        for _ in range(100):
            model.segment(shaded)
        assert np.abs(model.background[25:55, 25:55].astype(int) - before[25:55, 25:55]).max() <= 1

    def test_a_slow_local_change_is_learned_unless_frozen(self):
        rng = np.random.default_rng(3)
        for frozen in (False, True):
            model = learned(rng, BackgroundConfig(learning_rate=0.1))
            model.freeze(frozen)
            assert model.frozen is frozen
            for step in range(120):
                image = room(rng).astype(np.float32)
                image[20:70, 20:90] += (0.25 * step, 0, -0.25 * step)  # a lamp's colour, 30 grey levels in the end
                result = model.segment(np.clip(image, 0, 255).astype(np.uint8))
            assert bool(result.mask.any()) is frozen

    @pytest.mark.parametrize("light", [0.6, 1.3])
    def test_light_that_drifts_is_no_foreground(self, light):
        rng = np.random.default_rng(4)
        model = learned(rng)
        for t in np.linspace(0, 1, 40):
            result = model.segment(room(rng, light=1 + t * (light - 1)))
            assert not result.mask.any()
        assert result.gain == pytest.approx((light,) * 3, rel=0.01)
        image = room(rng, light=light)
        image[PERSON] = (30, 160, 60)
        truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
        truth[PERSON] = True
        assert iou(model.segment(image).mask > 0, truth) > 0.97

    def test_another_lamp_is_said_and_followed_with_somebody_in_the_room(self):
        rng = np.random.default_rng(5)
        model = learned(rng, BackgroundConfig(learning_frames=5))

        def evening(column):  # light from the side, of another colour
            slope = np.linspace(0.2, 1.6, WIDTH)[None, :, None] * (0.5, 0.9, 1.3)
            image = room(rng) * slope
            image[30:70, column : column + 20] = (30, 160, 60)
            return np.clip(image, 0, 255).astype(np.uint8)

        image = room(rng)
        image[PERSON] = (30, 160, 60)
        model.segment(image)
        for n in range(PATIENCE):
            result = model.segment(evening(50))
            assert result.light_jump is (n < PATIENCE - 1)
        assert (model.relit, result.learning) == (1, False)
        for column in (50, 52, 80):  # the last one: he went, and left no ghost behind
            truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
            truth[30:70, column : column + 20] = True
            assert iou(model.segment(evening(column)).mask > 0, truth) > 0.9
        # The first light is back: so is its background, at once, and he is seen.
        image = room(rng)
        image[PERSON] = (30, 160, 60)
        result = model.segment(image)
        assert (model.relit, result.light_jump) == (2, False)
        assert np.count_nonzero(result.mask) == pytest.approx(800, rel=0.1)

    def test_a_background_of_another_light_is_restored_with_somebody_in_the_room(self):
        rng = np.random.default_rng(9)
        picture = textured(rng) * 0.7
        model, again = (BackgroundModel(BackgroundConfig(learning_frames=5)) for _ in range(2))
        for _ in range(6):
            model.segment(noisy(rng, picture))
        again.restore(model.state())
        lit = picture * np.linspace(1.1, 1.9, WIDTH)[None, :, None]
        for column in (50, 50, 50, 50, 90):
            image = lit.copy()
            image[30:70, column : column + 20] = (30, 160, 60)
            result = again.segment(noisy(rng, image))
        assert again.relit == 1
        truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
        truth[30:70, 90:110] = True
        assert iou(result.mask > 0, truth) > 0.85  # and no ghost at the first place

    def test_a_lamp_that_lights_a_part_of_the_room_is_followed_and_who_comes_close_is_not_learned(self):
        rng = np.random.default_rng(8)
        picture = textured(rng) * 0.8
        model = BackgroundModel(BackgroundConfig(learning_frames=5))
        for _ in range(6):
            model.segment(noisy(rng, picture))
        x = np.linspace(0, 1, WIDTH)[None, :, None]
        lit = picture * (1 + 0.8 * x**3)
        for _ in range(PATIENCE):
            result = model.segment(noisy(rng, lit))
        assert (model.relit, result.learning, result.foreground_fraction < 0.02) == (1, False, True)
        close = lit.copy()
        close[:, 40:75] = (30, 160, 60)  # more than a quarter of the image, at once
        for _ in range(PATIENCE + 3):
            result = model.segment(noisy(rng, close))
        assert result.foreground_fraction == pytest.approx(35 / WIDTH, rel=0.1)
        assert not model.segment(noisy(rng, lit)).mask.any()

    def test_a_moved_camera_gives_no_mask_until_it_is_back(self):
        rng = np.random.default_rng(6)
        picture = textured(rng)
        model = BackgroundModel(BackgroundConfig(learning_frames=5))
        for _ in range(5):
            model.segment(noisy(rng, picture))
        for n in range(PATIENCE + MOVED_PATIENCE + 5):
            result = model.segment(noisy(rng, np.roll(picture, 30, axis=1)))
            assert result.light_jump
            assert result.moved is (n >= PATIENCE - 1)
            assert not result.mask.any()
        image = noisy(rng, picture)
        image[PERSON] = (30, 160, 60)
        result = model.segment(image)
        assert not result.moved
        assert np.count_nonzero(result.mask) == pytest.approx(800, rel=0.1)

    @pytest.mark.parametrize("level", [0, 255])
    def test_a_covered_lens_is_said_and_costs_nothing(self, level):
        rng = np.random.default_rng(6)
        picture, nothing = textured(rng), np.full((HEIGHT, WIDTH, 3), level, dtype=np.uint8)
        model = BackgroundModel(BackgroundConfig(learning_frames=5))
        assert model.segment(noisy(rng, nothing)).blind  # nor is it learned
        for _ in range(5):
            assert model.segment(noisy(rng, picture)).learning
        for _ in range(20):
            result = model.segment(noisy(rng, nothing))
            assert (result.blind, result.moved, result.light_jump, bool(result.mask.any())) == (
                True,
                False,
                False,
                False,
            )
        image = noisy(rng, picture)
        image[PERSON] = (30, 160, 60)
        assert np.count_nonzero(model.segment(image).mask) == pytest.approx(800, rel=0.1)

    def test_a_flash_does_not_cost_the_background(self):
        rng = np.random.default_rng(6)
        model = learned(rng)
        for _ in range(3):
            for _ in range(PATIENCE - 1):
                assert model.segment(255 - textured(rng)).light_jump
            result = model.segment(room(rng))
            assert not result.learning
            assert not result.mask.any()

    def test_grey_images(self):
        rng = np.random.default_rng(7)
        for as_colour in (False, True):
            model = BackgroundModel()

            def grey(paint=None, as_colour=as_colour):
                image = cv2.cvtColor(room(rng), cv2.COLOR_BGR2GRAY)
                if paint is not None:
                    image[PERSON] = paint
                return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if as_colour else image

            for _ in range(20):
                result = model.segment(grey())
            assert not result.mask.any()
            # 0.7 of the background would be a shadow in colour; grey images cannot tell, and keep it.
            assert np.count_nonzero(model.segment(grey(85)).mask[PERSON]) > 0.95 * 800

    def test_three_equal_channels_count_once(self):
        model = BackgroundModel()
        empty = np.full((HEIGHT, WIDTH, 3), 120, dtype=np.uint8)
        model.seed(empty)
        for offset, is_seen in ((7, False), (10, True)):  # sigma is the floor, 2: about 3.5 and 5 sigmas
            image = empty.copy()
            image[PERSON] += offset
            assert bool(model.segment(image).mask.any()) is is_seen

    def test_large_images_are_worked_on_smaller(self):
        rng = np.random.default_rng(8)
        shape = (240, 322)
        model = learned(rng, BackgroundConfig(max_pixels=25_000), shape=shape)
        image = room(rng, shape=shape)
        image[60:160, 100:150] = (30, 160, 60)
        truth = np.zeros(shape, dtype=bool)
        truth[60:160, 100:150] = True
        mask = model.segment(image).mask
        assert mask.shape == shape
        assert iou(mask > 0, truth) > 0.95

    def test_the_same_images_give_the_same_masks(self):
        def run():
            rng = np.random.default_rng(9)
            model = learned(rng)
            out = []
            for k in range(10):
                image = room(rng, light=1 - 0.01 * k)
                image[PERSON[0], 20 + 5 * k : 40 + 5 * k] = (30, 160, 60)
                out.append(model.segment(image).mask)
            return np.stack(out)

        first = run()
        assert first.any()
        np.testing.assert_array_equal(first, run())


class TestFirstImages:
    def test_a_camera_that_begins_with_black_images_has_colour(self):
        """A shadow is told by its colour; three equal channels, as of a black image, would tell none."""
        rng = np.random.default_rng(0)
        model = BackgroundModel()
        assert model.segment(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).blind
        while model.learning:
            model.segment(room(rng))
        shaded = room(rng)
        shaded[PERSON] = (shaded[PERSON] * 0.7).astype(np.uint8)
        assert not model.segment(shaded).mask.any()

    def test_refused_parameters_change_nothing(self):
        model = learned(np.random.default_rng(0))
        with pytest.raises(ConfigError, match="max_pixels"):
            model.config = dataclasses.replace(model.config, max_pixels=1)
        assert not model.learning


class TestSeeds:
    def test_one_picture_takes_the_noise_from_the_first_image(self):
        rng = np.random.default_rng(10)
        model = BackgroundModel()
        model.seed(room(rng, noise=0))
        assert not model.learning
        for _ in range(5):
            result = model.segment(room(rng, noise=6))
            assert not result.mask.any()
        image = room(rng, noise=6)
        image[PERSON] = (30, 160, 60)
        assert np.count_nonzero(model.segment(image).mask[PERSON]) > 0.95 * 800

    def test_many_pictures(self):
        rng = np.random.default_rng(11)
        model = BackgroundModel()
        model.seed([room(rng, noise=5) for _ in range(10)])
        assert not model.segment(room(rng, noise=5)).mask.any()

    def test_a_guess_from_a_recording_without_an_empty_room(self):
        rng = np.random.default_rng(12)
        frames = []
        for k in range(20):
            image = room(rng, light=1 - 0.005 * k)
            image[30:90, 5 * k : 5 * k + 25] = (30, 160, 60)  # covers a pixel in 5 of 20 frames
            frames.append(image)
        estimate = estimate_background(frames)
        assert np.abs(estimate.mean - room(rng, noise=0, light=0.95)).mean() < 1.5
        model = BackgroundModel()
        model.seed_estimate(estimate)
        truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
        truth[30:90, 50:75] = True
        assert iou(model.segment(frames[10]).mask > 0, truth) > 0.97

    def test_a_guess_for_images_larger_than_the_working_size(self):
        rng = np.random.default_rng(13)
        frames = [room(rng) for _ in range(4)]
        model = BackgroundModel(BackgroundConfig(max_pixels=10_000))
        model.seed_estimate(estimate_background(frames))
        assert not model.segment(room(rng)).mask.any()

    def test_too_little_to_guess_from(self):
        rng = np.random.default_rng(14)
        with pytest.raises(InputError, match="at least 3 frames"):
            estimate_background([room(rng)] * 2)
        with pytest.raises(InputError, match="one size"):
            estimate_background([room(rng), room(rng), room(rng, shape=(50, 50))])

    def test_no_picture(self):
        with pytest.raises(InputError, match="at least one background picture"):
            BackgroundModel().seed([])


class TestBadInput:
    def test_another_size(self):
        rng = np.random.default_rng(0)
        model = learned(rng)
        with pytest.raises(InputError, match=r"128x96 px.*got 64x48"):
            model.segment(np.zeros((48, 64, 3), dtype=np.uint8))
        model.recapture()
        assert model.segment(np.zeros((48, 64, 3), dtype=np.uint8)).learning

    @pytest.mark.parametrize(
        "image", [np.zeros((96, 128, 3)), np.zeros((96, 128, 4), np.uint8), np.zeros((4, 4, 3), np.uint8), None]
    )
    def test_not_an_image(self, image):
        with pytest.raises(InputError, match=r"expected an image"):
            BackgroundModel().segment(image)

    def test_impossible_parameters(self):
        with pytest.raises(ConfigError, match="learning_frames"):
            BackgroundModel(BackgroundConfig(learning_frames=0))

    def test_parameters_change_live(self):
        rng = np.random.default_rng(0)
        model = learned(rng)
        image = room(rng)
        image[PERSON] = (30, 160, 60)
        assert model.segment(image).mask.any()
        model.config = dataclasses.replace(model.config, min_blob_px=100_000)
        assert not model.segment(image).mask.any()


@pytest.mark.parametrize("camera", [f"cam{i}" for i in range(8)])
def test_a_rendered_walk(camera):
    """Shadows on the floor, drifting light, JPEG noise: the whole chain against the true silhouettes."""
    with np.load(WALK / "masks.npz") as archive:
        truth = np.unpackbits(archive[camera], axis=2)[:, :, :640] > 0
    model = BackgroundModel(BackgroundConfig(learning_frames=8))
    scores = []
    for i, is_person in enumerate(truth):
        image = cv2.imread(str(WALK / "rgb" / camera / f"{i:04d}.jpg"))
        result = model.segment(image)
        assert result.learning is (i < 8)
        if i >= 8:
            scores.append(iou(result.mask > 0, is_person))
    assert np.mean(scores) > 0.95
    assert min(scores) > 0.93
