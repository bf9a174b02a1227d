# SPDX-License-Identifier: Apache-2.0
"""The RViz file against what RViz reads (data/rviz_properties.yaml), and against what we publish."""

from pathlib import Path

import pytest
import yaml

from limbloc_ros.ros import topics
from limbloc_ros.ros.cloud_messages import SURFACE_POINT

ROOT = Path(__file__).parents[1]
RVIZ = yaml.safe_load((ROOT / "test" / "data" / "rviz_properties.yaml").read_text(encoding="utf-8"))
VIEW = yaml.safe_load((ROOT / "config" / "limbloc.rviz").read_text(encoding="utf-8"))
MANAGER = VIEW["Visualization Manager"]
DISPLAYS = {display["Name"]: display for display in MANAGER["Displays"]}


def unknown(given, known, besides=("Class", "Name", "Enabled")):
    """The properties that RViz would skip, and the values that it has no choice for."""
    found = []
    for name, value in given.items():
        if name in besides:
            continue
        if name not in known:
            found.append(name)
        elif known[name] == "topic":
            found += [f"{name}/{inner}" for inner in unknown(value, RVIZ["topic"])]
        elif known[name] is not None and value not in known[name]:
            found.append(f"{name}: {value}")
    return found


@pytest.mark.parametrize("name", DISPLAYS)
def test_rviz_reads_every_property_of_a_display(name):
    display = DISPLAYS[name]
    assert unknown(display, RVIZ["displays"][display["Class"]]) == []
    assert isinstance(display["Enabled"], bool)


def test_rviz_reads_the_rest_of_the_file():
    assert [panel["Class"] for panel in VIEW["Panels"]] == RVIZ["panels"]
    assert {tool["Class"] for tool in MANAGER["Tools"]} <= set(RVIZ["tools"])
    view = MANAGER["Views"]["Current"]
    assert unknown(view, RVIZ["views"][view["Class"]]) == []
    assert unknown(MANAGER["Global Options"], RVIZ["global_options"]) == []
    assert set(MANAGER) == {"Class", "Displays", "Global Options", "Tools", "Views"}
    assert len(DISPLAYS) == len(MANAGER["Displays"])


def test_a_wrong_property_would_be_found():
    known = RVIZ["displays"]["rviz_default_plugins/PointCloud2"]
    wrong = {"Size": 1, "Style": "Cubes", "Topic": {"Value": "/hull", "Reliability Policy": "Reliably"}}
    assert unknown(wrong, known) == ["Size", "Style: Cubes", "Topic/Reliability Policy: Reliably"]


def test_it_shows_topics_that_there_are():
    ours = {topics.HULL, topics.SURFACE, topics.MARKERS, topics.TRUE_JOINTS, topics.body_urdf("p1")}
    cameras = {topics.image("cam0"), topics.mask("cam0")}
    shown = [display[key] for display in DISPLAYS.values() for key in ("Topic", "Description Topic") if key in display]
    assert {topic["Value"] for topic in shown} == {f"/{name}" for name in ours | cameras}
    for topic in shown:  # what is latched is asked for latched, and camera drivers offer no more than best effort
        name = topic["Value"].removeprefix("/")
        assert (topic["Durability Policy"] == "Transient Local") == (name == topics.body_urdf("p1"))
        assert (topic["Reliability Policy"] == "Best Effort") == (name in cameras)
    channels = {display["Channel Name"] for display in DISPLAYS.values() if "Channel Name" in display}
    assert channels <= set(SURFACE_POINT.names)
    assert MANAGER["Global Options"]["Fixed Frame"] == "room"
