# SPDX-License-Identifier: Apache-2.0
"""What each node of a smart space may do, as an SROS2 policy: one enclave a process, one profile a node, nothing more.

`limbloc security` writes it for a `smart_space.yaml`; `docs/how_to/security.md` says how it becomes keys and signed
permissions. A test starts the nodes and holds the policy against what they have on the graph.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.ros import topics
from limbloc_ros.ros.supervisor import ENCLAVES, ProcessPlan

#: The enclave for people: it looks at results, and it alone may call what changes a running node.
OPERATOR = "operator"

#: Services that only tell something, of every node.
PARAMETERS_TOLD = ("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters")
#: Services that change the state of a running node: of every node, and of segmentation.
PARAMETERS_SET = ("set_parameters", "set_parameters_atomically")
BACKGROUND_SET = tuple(name.removeprefix("~/") for name in (topics.RECAPTURE_BACKGROUND, topics.FREEZE_BACKGROUND))
#: Told by every node since Jazzy.
TYPE_DESCRIPTION = "get_type_description"

#: What people and recordings look at.
_BODIES = tuple(
    of("*")
    for of in (
        *(topics.body_joints, topics.body_joint_angles, topics.body_joint_states),
        *(topics.body_urdf, topics.body_native_urdf, topics.body_posture),
    )
)
_RESULTS = (
    *(topics.HULL, topics.SURFACE, topics.JOINTS, topics.JOINT_ANGLES, topics.MARKERS, topics.TRUE_JOINTS),
    *(f"{topics.TRUE_JOINTS}_*", *_BODIES, topics.BODIES_TRACKED, topics.DIAGNOSTICS, "/tf", "/tf_static"),
)


@dataclass(frozen=True)
class Access:
    """Names as in `ros.topics`, relative to the node's namespace unless they begin with `/`; `*` stands for anything.

    Attributes:
        publish, subscribe: topics.
        reply, request: services that are offered and called.
    """

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()


def access_of(node: Mapping[str, Any], cameras: Sequence[str], sim_time: bool = False) -> Access:
    """What one node of a plan needs.

    Args:
        node: kind, name and parameters, as in `ProcessPlan`.
        cameras: all cameras of the smart space.
        sim_time: whether the node follows `/clock`.

    Raises:
        ConfigError: a kind of node that is not known.
    """
    name, parameters = node["name"], node["parameters"]
    services = [*PARAMETERS_TOLD, *PARAMETERS_SET, TYPE_DESCRIPTION]
    found = _of_kind(node["kind"], parameters, cameras)
    if node["kind"] == "segmentation":
        services += BACKGROUND_SET
    return replace(
        found,
        publish=(*found.publish, "/rosout", "/parameter_events"),
        subscribe=(*found.subscribe, *(["/clock"] if sim_time or parameters.get("use_sim_time") else [])),
        reply=tuple(f"{name}/{service}" for service in services),
    )


def _of_kind(kind: str, parameters: Mapping[str, Any], cameras: Sequence[str]) -> Access:
    """What the nodes of one kind need beyond what all nodes have."""
    image_of = {"raw": topics.image, "compressed": topics.image_compressed}
    mask_of = {"raw": topics.mask, "compressed": topics.mask_compressed}
    if kind == "segmentation":
        camera = parameters["camera"]
        return Access(
            (topics.FRAMES_SKIPPED, topics.mask(camera), topics.mask_compressed(camera), topics.DIAGNOSTICS),
            (topics.FRAMES_SKIPPED, image_of[parameters.get("transport", "raw")](camera)),
        )
    if kind == "carving":
        masks = [mask_of[parameters.get("mask_transport", "compressed")](camera) for camera in cameras]
        if not parameters.get("rig_file"):
            masks += [*(topics.camera_info(camera) for camera in cameras), "/tf", "/tf_static"]
        return Access((topics.HULL, topics.DIAGNOSTICS), (*masks, topics.FRAMES_SKIPPED, topics.JOINTS))
    if kind == "pose":
        own = (topics.JOINTS, topics.JOINT_ANGLES, topics.MARKERS, topics.SURFACE, *_BODIES, topics.BODIES_TRACKED)
        tf = () if parameters.get("publish_tf") == "none" else ("/tf",)
        return Access((*own, topics.DIAGNOSTICS, *tf), (topics.HULL,))
    if kind == "simulated_cameras":
        transport = parameters.get("transport", "raw")
        wanted = tuple(image_of) if transport == "both" else (transport,)
        images = [image_of[form](camera) for camera in cameras for form in wanted]
        truth = (topics.TRUE_JOINTS, f"{topics.TRUE_JOINTS}_*")
        infos = (topics.camera_info(camera) for camera in cameras)
        return Access((*images, *infos, *truth, topics.DIAGNOSTICS, "/tf_static"))
    if kind == "replay":
        # A plan names the recorded topics as regular expressions without anything special.
        recorded = [re.sub(r"\\(.)", r"\1", pattern) for pattern in parameters.get("topics", ())]
        clock = ("/clock",) if parameters.get("clock", True) else ()
        stepped = (parameters.get("result_topic", topics.JOINTS),) if parameters.get("mode") == "stepped" else ()
        return Access((*recorded, *clock), stepped)
    if kind in ("record", "foxglove_bridge"):
        return Access((), (*_cameras_topics(cameras), *_RESULTS, topics.FRAMES_SKIPPED))
    raise ConfigError(f"expected a kind of node that the smart space has, got {kind!r}")


def _cameras_topics(cameras: Sequence[str]) -> list[str]:
    kinds = (topics.image, topics.image_compressed, topics.camera_info, topics.mask, topics.mask_compressed)
    return [of(camera) for camera in cameras for of in kinds]


def operator_access(plans: Sequence[ProcessPlan]) -> Access:
    """What people's tools may do: look at results, and call every service of every node."""
    services: list[str] = []
    for node in (node for plan in plans for node in plan.nodes):
        services += access_of(node, ()).reply
    return Access(("/rosout", "/parameter_events"), (*_RESULTS, "/rosout", "/parameter_events"), (), tuple(services))


def cameras_of(plans: Sequence[ProcessPlan]) -> tuple[str, ...]:
    """The cameras that a plan's carving node takes part with."""
    carving = [node for plan in plans for node in plan.nodes if node["kind"] == "carving"]
    return tuple(carving[0]["parameters"]["cameras"]) if carving else ()


def policy(plans: Sequence[ProcessPlan]) -> str:
    """The SROS2 policy (version 0.2.0) of a smart space, as XML text."""
    root = ET.Element("policy", version="0.2.0")
    enclaves = ET.SubElement(root, "enclaves")
    cameras = cameras_of(plans)
    for plan in plans:
        profiles = ET.SubElement(ET.SubElement(enclaves, "enclave", path=f"{ENCLAVES}/{plan.name}"), "profiles")
        for node in plan.nodes:
            _add_profile(profiles, plan.namespace, node["name"], access_of(node, cameras))
    profiles = ET.SubElement(ET.SubElement(enclaves, "enclave", path=f"{ENCLAVES}/{OPERATOR}"), "profiles")
    _add_profile(profiles, plans[0].namespace if plans else "", OPERATOR, operator_access(plans))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add_profile(profiles: ET.Element, namespace: str, name: str, access: Access) -> None:
    space = "/" + namespace.strip("/")
    profile = ET.SubElement(profiles, "profile", ns=space, node=name)
    for group, item, rule, names in (
        ("topics", "topic", "publish", access.publish),
        ("topics", "topic", "subscribe", access.subscribe),
        ("services", "service", "reply", access.reply),
        ("services", "service", "request", access.request),
    ):
        if names:
            allowed = ET.SubElement(profile, group, {rule: "ALLOW"})
            for expression in sorted({absolute(name, space) for name in names}):
                ET.SubElement(allowed, item).text = expression


def absolute(name: str, namespace: str) -> str:
    """A topic's or service's name with its namespace, as the graph has it."""
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
