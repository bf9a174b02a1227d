# SPDX-License-Identifier: Apache-2.0
"""When a pose is called reliable, and why not."""

import dataclasses

import numpy as np
import pytest

from limbloc_ros.core import confidence
from limbloc_ros.core.confidence import DOUBTFUL, SURE, WARY_FRAMES, Judge, Wariness, risk_of
from limbloc_ros.core.engine_robust import WORTH_A_SEARCH
from limbloc_ros.core.figure import FigureState, place
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import Pose

BODY = place(FigureState.standing(np.array([0.0, 0.0, 0.95]))).flesh()
SHOWN = np.array([[0.16, 0.26, 0.65], [0.16, 0.26, 0.65]])
FAINT = SHOWN * [[1.0, 1.0, 1.0], [0.3, 0.3, 1.0]]  # the right arm
ARM_HIDDEN = "arm hardly shows in the silhouettes"


@pytest.fixture(autouse=True)
def depths(monkeypatch):
    """How deep the forearms lie in other flesh, to be changed by tests."""
    depths = np.array([-0.17, -0.17])
    monkeypatch.setattr(confidence, "forearm_depths_m", lambda flesh: depths)
    return depths


def block(shape=(40, 40, 40), at=(0, 0, 0)) -> Hull:
    """A hull that fills its grid but for the outermost voxels."""
    sdf = np.full(shape, 0.06, np.float32)
    sdf[3:-3, 3:-3, 3:-3] = -0.05
    return Hull(0.02, at, sdf, 0.06)


def asked(passed_m: float = 0.04, shown=SHOWN, energy: float = 0.3, hull: Hull | None = None) -> str:
    risk, sign = risk_of(hull or block(), BODY, energy, np.asarray(shown), passed_m)
    assert 0.0 <= risk <= 1.0
    return sign if risk >= DOUBTFUL else ""


def test_nothing_is_doubted_without_a_sign():
    assert asked() == ""
    assert risk_of(block(), BODY, 0.3, None, 0.1) == (0.0, "")


@pytest.mark.parametrize("side", ["left", "right"])
def test_an_arm_that_hardly_shows_is_named(side):
    shown = SHOWN.copy()
    shown[["left", "right"].index(side), :2] = 0.01, 0.02
    assert asked(shown=shown) == f"the {side} arm hardly shows in the silhouettes"
    assert asked(shown=np.zeros((2, 3)))  # and where it does not show at all


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_leg_that_hardly_shows_is_named(side):
    shown = SHOWN.copy()
    shown[["left", "right"].index(side), 2] = 0.002
    assert asked(shown=shown) == f"the {side} leg hardly shows in the silhouettes"


def test_what_the_figure_has_not_is_told_with_its_distance():
    assert "something 16 cm beside the figure" in asked(passed_m=0.16)
    assert asked(passed_m=0.15) == ""
    assert "something 15 cm beside the figure" in asked(passed_m=0.15, shown=0.5 * SHOWN)
    assert risk_of(block(), BODY, 0.3, None, 0.2)[0] == 1.0


def test_each_sign_makes_a_pose_less_likely_right():
    """Where one sign alone is not enough, two are."""
    assert asked(shown=FAINT) == "" and asked(passed_m=0.14) == ""
    assert asked(shown=FAINT, passed_m=0.14)


def test_a_forearm_in_other_flesh_is_a_sign(depths):
    assert asked(shown=FAINT, passed_m=0.09) == ""
    depths[1] = 0.08
    assert asked(shown=FAINT, passed_m=0.09) == f"the right {ARM_HIDDEN}"
    assert risk_of(block(), BODY, 0.3, SHOWN, 0.04)[1] == "the right forearm lies close to other parts"
    depths[:] = 0.08, -0.17
    assert risk_of(block(), BODY, 0.3, SHOWN, 0.04)[1] == "the left forearm lies close to other parts"


def test_a_figure_of_no_such_hull_and_half_a_person():
    assert "XOR energy 0.70" in asked(energy=0.70)
    cut = block()
    cut.sdf[-2, 3:-3, 3:-3] = -0.05  # up to the wall, and outside beyond it
    assert "carve volume" in asked(hull=dataclasses.replace(cut, sdf=cut.sdf))


def test_what_is_worth_another_search(monkeypatch):
    hull, state = block(), FigureState.standing(np.array([0.0, 0.0, 0.95]))
    monkeypatch.setattr(confidence, "xor_energy", lambda hull, placed: 0.3)
    said = [SHOWN, 0.04]
    monkeypatch.setattr(Judge, "_say", lambda self, flesh: tuple(said))

    def worth_a_search(hull):
        return Judge(hull).risk_worth_a_search(state) >= WORTH_A_SEARCH

    assert not worth_a_search(hull)
    said[1] = 0.19  # an outline passes the figure by 19 cm
    assert worth_a_search(hull)
    said[:] = SHOWN * [[1.0, 1.0, 1.0], [0.05, 0.05, 1.0]], 0.04
    assert worth_a_search(hull)
    # half a person is doubted, but nobody would find a better figure of that hull
    cut = hull.sdf.copy()
    cut[-2, 3:-3, 3:-3] = -0.05
    assert not worth_a_search(dataclasses.replace(hull, sdf=cut))


def test_a_followed_figure_that_was_doubted_must_be_clearly_right_for_some_frames():
    nothing = np.zeros(1)
    fit = Pose(
        BODY.centres[:25],
        np.zeros((1, 3, 3)),
        ("pelvis",),
        {},
        {},
        BODY,
        nothing,
        0.2,
        np.zeros(25),
        True,
        {},
        risk=0.05,
    )
    doubted = dataclasses.replace(fit, reliable=False, risk=0.5, doubt="why")
    clear = dataclasses.replace(fit, risk=0.5 * SURE)
    wary = Wariness()
    assert wary.judge(fit) is fit
    assert wary.judge(doubted) is doubted
    assert wary.judge(clear) is clear
    told = wary.judge(fit)
    assert not told.reliable and "in doubt just before" in told.doubt and told.risk == fit.risk
    for _ in range(WARY_FRAMES - 2):
        wary.judge(clear)
    assert wary.judge(fit) is fit
