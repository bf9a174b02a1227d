# SPDX-License-Identifier: Apache-2.0
"""Config dataclasses as ROS parameters of a real node: declared with bounds, overridden, changed live, refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_graph import DOMAIN

from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig, setting
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.ros.parameters import NodeParameters


@dataclass(frozen=True)
class Lists:
    cameras: tuple[str, ...] = setting((), "names")
    corner_m: tuple[float, ...] = setting((1.0, 2.0, 3.0), "a corner", unit="m", live=True)


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    yield context
    rclpy.shutdown(context=context)


def make_node(context: Context, **overrides: object) -> Node:
    parameters = [Parameter(name.replace("__", "."), value=value) for name, value in overrides.items()]
    return Node("node", context=context, parameter_overrides=parameters, start_parameter_services=False)


def test_defaults_are_those_of_the_dataclass(context: Context) -> None:
    parameters = NodeParameters(make_node(context))
    assert parameters.declare(BackgroundConfig, "background") == BackgroundConfig()
    assert parameters.declare(FitConfig) == FitConfig()
    assert parameters.declare(Lists) == Lists()


def test_overrides_win(context: Context) -> None:
    node = make_node(context, hull__voxel_m=0.03, hull__min_cameras=3, cameras=["a", "b"], corner_m=[4.0, 5.0, 6.0])
    parameters = NodeParameters(node)
    config = parameters.declare(HullConfig, "hull")
    assert (config.voxel_m, config.min_cameras) == (0.03, 3)
    assert parameters.declare(Lists) == Lists(("a", "b"), (4.0, 5.0, 6.0))


def test_description_unit_and_bounds_are_visible(context: Context) -> None:
    node = make_node(context)
    NodeParameters(node).declare(HullConfig, "hull")
    voxel = node.describe_parameter("hull.voxel_m")
    assert voxel.description == "edge length of a voxel [m]"
    assert voxel.read_only
    assert (voxel.floating_point_range[0].from_value, voxel.floating_point_range[0].to_value) == (0.005, 0.10)
    cameras = node.describe_parameter("hull.min_cameras")
    assert not cameras.read_only
    assert (cameras.integer_range[0].from_value, cameras.integer_range[0].to_value) == (1, 64)


@pytest.mark.parametrize(
    ("kind", "override", "words"),
    [
        (HullConfig, {"voxel_m": 0.2}, ["voxel_m", "0.005 to 0.1 m"]),
        (HullConfig, {"voxel_m": 1}, ["voxel_m", "write 1.0"]),
        (HullConfig, {"min_cameras": "two"}, ["min_cameras", "int from 1 to 64"]),
        (FitConfig, {"engine": "magic"}, ["engine", "robust, paper", "magic"]),
        (Lists, {"cameras": [1, 2]}, ["cameras", "array"]),
    ],
)
def test_bad_override_names_the_parameter_and_what_was_expected(
    context: Context, kind: type, override: dict[str, object], words: list[str]
) -> None:
    with pytest.raises(ConfigError) as caught:
        NodeParameters(make_node(context, **override)).declare(kind)
    for word in words:
        assert word in str(caught.value)


def test_live_change_reaches_the_node_and_a_bad_one_is_refused(context: Context) -> None:
    node = make_node(context)
    seen: list[BackgroundConfig] = []
    NodeParameters(node).declare(BackgroundConfig, "background", seen.append)

    assert node.set_parameters([Parameter("background.threshold_sigmas", value=6.0)])[0].successful
    assert [config.threshold_sigmas for config in seen] == [6.0]

    too_high = node.set_parameters([Parameter("background.threshold_sigmas", value=60.0)])[0]
    assert not too_high.successful
    start_only = node.set_parameters([Parameter("background.learning_frames", value=3)])[0]
    assert not start_only.successful
    assert "read-only" in start_only.reason
    assert node.get_parameter("background.threshold_sigmas").value == 6.0
    assert len(seen) == 1


def test_live_choice_out_of_list_is_refused_with_the_choices(context: Context) -> None:
    @dataclass(frozen=True)
    class Modes:
        mode: str = setting("all", "what to do", choices=("all", "none"), live=True)

    globals()["Modes"] = Modes
    node = make_node(context)
    seen: list[Modes] = []
    NodeParameters(node).declare(Modes, on_change=seen.append)
    refused = node.set_parameters([Parameter("mode", value="some")])[0]
    assert not refused.successful
    assert "all, none" in refused.reason
    assert not seen


def test_atomic_change_over_two_sections_is_all_or_nothing(context: Context) -> None:
    node = make_node(context)
    seen: list[object] = []
    parameters = NodeParameters(node)
    parameters.declare(BackgroundConfig, "background", seen.append)
    parameters.declare(Lists, "lists", seen.append)
    result = node.set_parameters_atomically(
        [Parameter("background.open_px", value=2), Parameter("background.sigma_floor", value=1000.0)]
    )
    assert not result.successful
    assert not seen
    assert node.set_parameters_atomically(
        [Parameter("background.open_px", value=2), Parameter("lists.corner_m", value=[0.0, 0.0, 1.0])]
    ).successful
    assert seen == [BackgroundConfig(open_px=2), Lists(corner_m=(0.0, 0.0, 1.0))]


def test_whole_numbers_in_a_list_of_floats_are_explained(context: Context) -> None:
    with pytest.raises(ConfigError, match=r"corner_m.*write 1\.0, not 1"):
        NodeParameters(make_node(context, corner_m=[1, 2, 3])).declare(Lists)
