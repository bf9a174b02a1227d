# SPDX-License-Identifier: Apache-2.0
"""Images of one camera -> foreground masks: running Gaussian average (paper section 1, after Wren et al. 1997).

Every pixel has a mean and a variance per channel; a pixel far from its mean is foreground and teaches the model
nothing. Around this core, because real rooms need it:

* the light's slow drift is one gain per channel and frame, taken from the background itself;
* a shadow darkens a pixel and leaves its colour, so only what a factor `shadow_darkest .. highlight_brightest` on the
  background cannot explain counts as foreground (Horprasert et al. 1999);
* the evidence is cleaned into a mask by hysteresis, morphology and trimming (`mask_cleaning`);
* when most of the image changes at once, the light was switched or the camera moved: a background of before that fits
  is taken again; else the old one is brought to the new light (`relight`), whoever is in the room; and when it is
  another view, there is no mask until the old one is back;
* an image of one brightness only (a covered lens, a dead sensor) says nothing and changes nothing.

A mask depends on the images given before and on nothing else.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._background_kernels import add_to_mean, fix_all, learn, sampled
from limbloc_ros.core._bit_kernels import no_pixels, spread
from limbloc_ros.core._mask_kernels import place
from limbloc_ros.core.background_estimate import BackgroundEstimate, estimate_background, light_over, noise_variance
from limbloc_ros.core.background_evidence import (
    LOOKED_ROWS,
    Background,
    Evidence,
    Look,
    at_working_size,
    change_level,
    light_change,
    light_of,
    light_stride,
    look_at,
    measure_evidence,
    planes_of,
    scale_of,
)
from limbloc_ros.core.config import BackgroundConfig, validated
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.mask_cleaning import clean_mask
from limbloc_ros.core.relight import relight, shows_nothing
from limbloc_ros.core.segmentation import Segmentation

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

PATIENCE = 3
"""Frames in a row that must disagree with the whole background before anything follows (a flash is shorter)."""

FORMER, FITS = 2, 0.3
"""So many backgrounds of before are kept, and one is taken again when less than this share of the image differs."""

PARTLY, SURELY_SAME, SURELY_LIGHT = 0.15, 0.8, 0.75
"""When suddenly more than this share of the image differs, but not most of it, light is believed to be the cause only
when the background's edges are still there with this correlation, and when this share of what differs changed as
smoothly as light does."""

SWITCHED = 0.15
"""When the logarithm of the light's gain changes by more from image to image, a background of before may fit better."""

MOVED_PATIENCE = 10
"""While a camera shows another view, every so many frames it is looked whether only the light has changed as well."""

LEARNED_ROWS = 16
"""Every row of pixels learns from every 16th image, with a rate to match: the same background in less time."""

RESTLESS_SIGMA, UNREST = 10.0, 0.005
"""A pixel that varied more than this (grey levels) while the background was learned was not empty; and the share of
such pixels from which on somebody must have moved. Empty rooms had none, rooms with somebody who walks 3 to 20 %."""

_ONES = np.ones(3, dtype=np.float32)
_RIM = np.full(5, 2, dtype=np.int32)


class BackgroundModel:
    """The background of one camera. Give it every image in order; it is not thread-safe."""

    def __init__(self, config: BackgroundConfig | None = None) -> None:
        """Start without a background: the first `config.learning_frames` images must be free of people.

        Raises:
            ConfigError: a value is out of its bounds.
        """
        self._config = validated(config or BackgroundConfig())
        self._image_shape: tuple[int, ...] | None = None
        self._grey = False
        self._frozen = False
        self._former: deque[tuple[Floats, NDArray[np.float16]]] = deque(maxlen=FORMER)
        self._relit = 0
        self._forget()

    def _forget(self) -> None:
        self._mean = np.zeros((3, 0, 0), dtype=np.float32)
        self._variance = self._mean.copy()
        self._level = np.zeros(self._mean.shape, dtype=np.uint16)
        self._sharpness = self._level.copy()
        self._gain = _ONES
        self._busy = no_pixels(0, 0)
        self._before: Evidence | None = None  # of the last image that was not doubted
        self._share, self._doubts = 0.0, 0
        self._fresh = True  # no image has been segmented yet: somebody may be there whom we never saw
        self._learned = 0
        self._ready = False
        self._noise_known = False
        self._unrest = 0.0
        self._upset = 0
        self._turn = 0

    @property
    def config(self) -> BackgroundConfig:
        """The parameters in use; assign to change them between two images."""
        return self._config

    @config.setter
    def config(self, config: BackgroundConfig) -> None:
        config = validated(config)
        if config.max_pixels != self._config.max_pixels:
            self.recapture()
        self._config = config
        self._fix_model()

    @property
    def learning(self) -> bool:
        """Whether the background is still unknown."""
        return not self._ready

    @property
    def unrest(self) -> float:
        """Share of the pixels that changed while the background was learned: somebody moved if it is above UNREST."""
        return self._unrest

    @property
    def frozen(self) -> bool:
        """Whether the background is kept as it is."""
        return self._frozen

    @property
    def relit(self) -> int:
        """How often the background was brought to another light, or one of before was taken again."""
        return self._relit

    @property
    def background(self) -> Bytes | None:
        """uint8 [h, w, 3] the learned background at working size, or None before the first image."""
        if self._learned == 0:
            return None
        return np.clip(np.rint(self._mean), 0, 255).astype(np.uint8).transpose(1, 2, 0)

    def freeze(self, on: bool = True) -> None:
        """Stop (or resume) learning from background pixels.

        The gain of the light is still followed; when the light is switched, there is no mask until this is undone.
        """
        self._frozen = on

    def recapture(self) -> None:
        """Forget the background; the next `learning_frames` images must be free of people. Any size is accepted."""
        self._forget()
        self._former.clear()
        self._image_shape = None

    def seed(self, images: Bytes | Sequence[Bytes]) -> None:
        """Start from pictures of the empty room instead of learning it.

        Args:
            images: one or more uint8 [H, W, 3] or [H, W] of the size of the images to come. With fewer than five,
                the noise is estimated from the first image that is segmented.

        Raises:
            InputError: no picture, wrong type or unequal sizes.
        """
        pictures = [images] if isinstance(images, np.ndarray) else list(images)
        if not pictures:
            raise InputError("expected at least one background picture, got none; pass pictures of the empty room")
        self.recapture()
        for picture in pictures:
            self._learn(self._working(picture))
        self._finish_learning()

    def seed_estimate(self, estimate: BackgroundEstimate) -> None:
        """Start from `estimate_background`; its noise is a lower bound, the rest comes from the first image."""
        self.recapture()
        image = self._working(np.clip(np.rint(estimate.mean), 0, 255).astype(np.uint8))
        size = (image.shape[1], image.shape[0])
        for c in range(3):
            mean, sigma = (np.ascontiguousarray(a[..., c], dtype=np.float32) for a in (estimate.mean, estimate.sigma))
            planes_c = (mean, sigma * sigma)
            if mean.shape != image.shape[:2]:
                planes_c = (
                    cv2.resize(mean, size, interpolation=cv2.INTER_AREA),
                    cv2.resize(sigma * sigma, size, interpolation=cv2.INTER_AREA),
                )
            if c == 0:
                self._allocate(planes_of(image))
            self._mean[c], self._variance[c] = planes_c
        self._learned = 1
        self._ready = True
        self._fix_model()

    def state(self) -> dict[str, NDArray[Any]] | None:
        """All that `restore` needs to go on from here; None while the background is unknown."""
        if not self._ready:
            return None
        assert self._image_shape is not None
        return {
            "mean": self._mean,
            "variance": self._variance,
            "gain": self._gain,
            "image_shape": np.array(self._image_shape),
            "max_pixels": np.array(self._config.max_pixels),
            "learned": np.array(self._learned),
            "grey": np.array(self._grey),
            "noise_known": np.array(self._noise_known),
            "frozen": np.array(self._frozen),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave.

        Raises:
            InputError: it is not such a state, or of another working size (`max_pixels`).
        """
        try:
            mean, variance = (np.array(state[key], dtype=np.float32) for key in ("mean", "variance"))
            gain = np.array(state["gain"], dtype=np.float32)
            height, width = (int(n) for n in state["image_shape"])
            flags = [bool(state[key]) for key in ("grey", "noise_known", "frozen")]
            learned, max_pixels = int(state["learned"]), int(state["max_pixels"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"expected a saved background, got something else ({error})") from None
        fits = mean.ndim == 3 and mean.shape[0] == 3 and variance.shape == mean.shape and gain.shape == (3,)
        if not fits or max_pixels != self._config.max_pixels:
            raise InputError(
                f"expected a saved background of at most {self._config.max_pixels} px, got one made with max_pixels "
                f"{max_pixels} and arrays of {mean.shape} and {variance.shape}"
            )
        if not (np.isfinite(mean).all() and np.isfinite(variance).all() and np.isfinite(gain).all()):
            raise InputError("expected a saved background of finite numbers")
        self._forget()
        self._mean, self._variance, self._gain, self._image_shape = mean, variance, gain, (height, width)
        self._grey, self._noise_known, self._frozen = flags
        self._busy = no_pixels(*mean.shape[1:])
        self._learned, self._ready = learned, True
        self._fix_model()

    def segment(self, image: Bytes) -> Segmentation:
        """Segment the next image of this camera.

        Args:
            image: uint8 [H, W, 3] (any fixed channel order) or [H, W]. Grey images, also those stored with three
                equal channels, carry no colour to tell a shadow by: shadows stay foreground.

        Returns:
            the mask and the state of the model.

        Raises:
            InputError: not an 8-bit image, or another size than before (`recapture` accepts a new size).
        """
        image = self._working(image)
        if not self._ready and shows_nothing(image, None):
            return self._no_mask(blind=True)
        if not self._ready and not self._recall(image, FITS):
            self._learn(image)
            if self._learned >= self._config.learning_frames:
                self._finish_learning()
            return self._no_mask()
        last, self._gain = self._gain, light_of(image, self._samples, self._busy, self._gain)
        if not self._noise_known:
            self._estimate_noise(image)
        looked = self._look(image)
        if looked.share > FITS and shows_nothing(image, self._mean):
            return self._no_mask(blind=True)
        if looked.share > self._config.relearn_fraction:
            moved = self._light_jumped(image)
            if moved is not None:
                return self._no_mask(light_jump=True, moved=moved)
        switched = light_change(self._gain, last) > SWITCHED and self._recall(image, 0.8 * looked.share)
        if switched or looked.share > self._config.relearn_fraction or self._partly_jumped(image, looked):
            looked = self._look(image)
        self._upset, self._fresh = 0, False
        evidence = self._measure(image, looked)
        if not self._doubts:
            self._before, self._share = evidence, looked.share
        part = clean_mask(evidence.change, evidence.colour, self._config, scale_of(image.size // 3))
        mask, self._busy, count = place(part, evidence.top, evidence.left, _RIM, *image.shape[:2])
        if not self._frozen and self._config.learning_rate > 0:
            self._follow(image, looked)
        fraction, gain = count / mask.size, tuple(self._gain.tolist())
        return Segmentation(self._full_size(mask), False, self._learned, fraction, False, gain)

    def _working(self, image: Bytes) -> Bytes:
        """Check an image and bring it to [h, w, 3] at working size."""
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            kind = getattr(image, "dtype", type(image).__name__)
            raise InputError(f"expected an image as uint8 array, got {kind}; convert it to 8 bits per channel first")
        if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or min(image.shape[:2]) < 16:
            raise InputError(
                f"expected an image [H, W, 3] or [H, W] of at least 16x16 px, got an array of shape {image.shape}; "
                "drop the alpha channel or convert the image first"
            )
        if self._image_shape is None:
            self._image_shape = image.shape[:2]
        elif image.shape[:2] != self._image_shape:
            height, width = self._image_shape
            raise InputError(
                f"expected images of {width}x{height} px like the background, got {image.shape[1]}x{image.shape[0]}; "
                "give every camera its own model, or capture the background anew after changing the resolution"
            )
        if image.ndim == 2:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        return at_working_size(image, self._config.max_pixels)

    def _full_size(self, mask: Bytes) -> Bytes:
        assert self._image_shape is not None
        height, width = self._image_shape
        if mask.shape == (height, width):
            return mask
        smooth = cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(cv2.threshold(smooth, 127, 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)

    def _no_mask(self, light_jump: bool = False, moved: bool = False, blind: bool = False) -> Segmentation:
        assert self._image_shape is not None
        mask = np.zeros(self._image_shape, dtype=np.uint8)
        return Segmentation(mask, True, self._learned, 0.0, light_jump, tuple(map(float, self._gain)), moved, blind)

    def _allocate(self, planes: Bytes) -> None:
        self._mean = planes.astype(np.float32)
        self._variance = np.zeros_like(self._mean)
        # Told by the first image that is learned: many a camera begins with black ones.
        self._grey = bool((np.ptp(planes[:, ::4, ::4].astype(np.int16), axis=0) <= 2).all())
        self._busy = no_pixels(*planes.shape[1:])
        self._learned = 1

    def _learn(self, image: Bytes) -> None:
        """Add one person-free image: running mean and sum of squares (Welford) under the first image's light."""
        planes = planes_of(image)
        if self._learned == 0:
            self._allocate(planes)
            return
        gain = light_over(image, self._mean)
        self._learned += 1
        add_to_mean(planes, gain, self._learned, self._mean, self._variance)

    def _finish_learning(self) -> None:
        self._ready = True
        varied = self._variance.max(axis=0) / np.float32(max(self._learned - 1, 1))
        self._unrest = float(np.count_nonzero(varied > RESTLESS_SIGMA**2)) / varied.size
        self._noise_known = self._learned >= 5
        if self._noise_known:
            # A variance from a few frames is itself noisy; neighbours share their camera's noise.
            for c in range(3):
                self._variance[c] = cv2.blur(self._variance[c] / np.float32(self._learned - 1), (5, 5))
        self._fix_model()

    def _estimate_noise(self, image: Bytes) -> None:
        """Take each pixel's noise from one image: the background has none yet."""
        self._variance = np.maximum(self._variance, noise_variance(planes_of(image), self._mean, self._gain))
        self._noise_known = True
        self._fix_model()

    def _fix_model(self) -> None:
        weight, floor = self._weight_and_floor()
        self._level = np.empty(self._mean.shape, dtype=np.uint16)
        self._sharpness = np.empty_like(self._level)
        fix_all(self._mean, self._variance, floor, weight, self._level, self._sharpness)
        self._stride = light_stride(self._mean[0].size)
        self._samples = sampled(self._level, self._stride)

    def _weight_and_floor(self) -> tuple[np.float32, np.float32]:
        # Three copies of one channel must not count as three measurements.
        return np.float32(1 / 3 if self._grey else 1), np.float32(self._config.sigma_floor**2)

    def _background(self) -> Background:
        darkest, brightest = self._config.shadow_darkest, self._config.highlight_brightest
        if self._grey:  # three equal channels: no colour tells a shadow
            darkest = brightest = 1.0
        return Background(self._level, self._sharpness, self._gain, np.float32(darkest), np.float32(brightest))

    def _look(self, image: Bytes) -> Look:
        return look_at(image, self._background(), self._config, self._turn)

    def _measure(self, image: Bytes, looked: Look) -> Evidence:
        """Change and colour of an image, everywhere when much of it is not the background's."""
        everywhere = looked.share > min(max(PARTLY, 1.5 * self._share), FITS)
        return measure_evidence(image, looked, self._background(), self._config, everywhere)

    def _follow(self, image: Bytes, looked: Look) -> None:
        """Let the background pixels of this image's share of rows learn."""
        weight, floor = self._weight_and_floor()
        rate = np.float32(1.0 - (1.0 - self._config.learning_rate) ** LEARNED_ROWS)
        model = self._mean, self._variance, self._level, self._sharpness, self._samples, self._stride, self._gain
        turn = looked.first, LOOKED_ROWS, self._turn // LOOKED_ROWS, LEARNED_ROWS // LOOKED_ROWS
        learn(image, *model, self._busy, looked.changed, rate, floor, weight, *turn)
        self._turn = (self._turn + 1) % LEARNED_ROWS

    def _changed(self, evidence: Evidence | None) -> Bytes:
        """Where an image was not the background [h, w]."""
        shape = self._mean.shape[1:]
        return np.zeros(shape, np.uint8) if evidence is None else evidence.changed(shape, change_level(self._config))

    def _somebody(self) -> Bytes:
        """Where something else than background was a moment ago [h, w]."""
        return self._changed(self._before) | np.asarray(spread(self._busy, self._mean.shape[2]), dtype=np.uint8)

    def _partly_jumped(self, image: Bytes, looked: Look) -> bool:
        """Whether suddenly much more differs because of the light, which is followed then; or somebody came close."""
        if self._frozen or looked.share <= PARTLY or looked.share <= 2 * self._share:
            self._doubts = 0
            return False
        self._doubts = (self._doubts + 1) % PATIENCE
        if self._doubts:
            return False
        if self._recall(image, min(FITS, looked.share / 2)):
            return True
        found = relight(planes_of(image), self._mean, self._somebody(), cautious=True)
        new = (self._changed(self._measure(image, looked)) > 0) & (self._changed(self._before) == 0)
        is_light = bool(np.count_nonzero(new & found.follows) > SURELY_LIGHT * np.count_nonzero(new))
        return is_light and found.agreement > SURELY_SAME and self._adopt(found.mean)

    def _light_jumped(self, image: Bytes) -> bool | None:
        """Most of the image differs. None when there is a background for it now; else whether the camera has moved."""
        self._upset += 1
        if self._frozen:
            return False
        if self._recall(image, FITS):
            return None
        if self._upset < PATIENCE or (self._upset - PATIENCE) % MOVED_PATIENCE:
            return self._upset > PATIENCE
        found = relight(planes_of(image), self._mean, self._somebody(), cautious=self._fresh)
        if found.other_view:
            return True
        if not found.same_view:
            self._keep(self._mean, self._variance)
            self._forget()
            self._learn(image)
            return False
        self._adopt(found.mean)
        return None

    def _adopt(self, mean: Floats) -> bool:
        """Go on with the background under another light."""
        self._keep(self._mean, self._variance)
        brighter = np.clip(mean / np.maximum(self._mean, 1.0), 1.0, 3.0)
        self._variance *= brighter * brighter  # noise grows with the light, if it does
        self._mean, self._gain = mean, _ONES
        self._relit += 1
        self._fix_model()
        return True

    def _keep(self, mean: Floats, variance: Floats) -> None:
        """Put a background by: its light may come back."""
        self._former.append((mean.copy(), np.minimum(variance, 6e4).astype(np.float16)))

    def _recall(self, image: Bytes, most: float) -> bool:
        """Take a background of before again when at most this share of the image differs from it."""
        kept = self._mean, self._variance, self._gain
        for n, former in reversed(list(enumerate(self._former))):
            self._mean, self._variance = former[0], former[1].astype(np.float32)
            self._fix_model()
            nobody = no_pixels(*self._mean.shape[1:])
            self._gain = light_of(image, self._samples, nobody, _ONES)
            if self._look(image).share > most:
                continue
            del self._former[n]
            if self._ready:
                self._keep(*kept[:2])
            self._busy, self._before = nobody, None
            self._learned, self._ready, self._noise_known = max(self._learned, 1), True, True
            self._upset, self._relit = 0, self._relit + 1
            return True
        if self._former:
            self._mean, self._variance, self._gain = kept
            self._fix_model()
        return False


@functools.cache  # once per process
def warm_up() -> None:
    """Compile or load the kernels, so that the first image is not slow."""
    config = dataclasses.replace(BackgroundConfig(), learning_frames=2, relearn_fraction=1.0)
    model = BackgroundModel(config)
    image = np.full((64, 64, 3), 100, dtype=np.uint8)
    for _ in range(3):
        model.segment(image)
    somebody = image.copy()
    somebody[12:52, 24:40] = 20, 60, 200  # masks are only cleaned where there is something
    model.segment(somebody)
    estimate_background([image] * 3)
