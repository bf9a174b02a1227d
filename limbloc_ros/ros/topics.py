# SPDX-License-Identifier: Apache-2.0
"""Every topic and service name and every QoS profile, once.

Names are relative, so that a namespace moves the whole graph; only `/diagnostics`, `/tf` and `/clock` are absolute,
as everywhere in ROS.

Each carved set gives exactly one message on `hull` (an empty cloud when nobody is there), and each hull exactly one on
`joints` (an empty array when there is no posture to act on): whoever waits for a result always gets one.

`joints` and `joint_angles` are of one person: of several the one who has been followed longest. Everybody has the same
below `humans/bodies/<id>`.

Images are subscribed best effort, which every camera driver offers; everything we publish is reliable, because a
reliable publisher also serves best-effort subscribers, RViz asks for reliable, and best-effort messages of some 100 KB
are lost by an untuned Fast DDS (config/fastdds.xml). The queues hold what comes during a slow moment of the node behind
them; who stays behind skips whole frames and says so (`backlog`), so that nothing grows late without end.
"""

from __future__ import annotations

import re

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from limbloc_ros.core.errors import ConfigError

# --- per camera ---


def image(camera: str) -> str:
    """sensor_msgs/Image of a camera."""
    return f"{camera}/image_raw"


def image_compressed(camera: str) -> str:
    """sensor_msgs/CompressedImage (JPEG or PNG) of a camera."""
    return f"{camera}/image_raw/compressed"


def camera_info(camera: str) -> str:
    """sensor_msgs/CameraInfo of a camera."""
    return f"{camera}/camera_info"


def mask(camera: str) -> str:
    """sensor_msgs/Image, mono8, 255 = foreground."""
    return f"{camera}/mask"


def mask_compressed(camera: str) -> str:
    """sensor_msgs/CompressedImage, bilevel PNG of the mask (about 1 KB)."""
    return f"{camera}/mask/compressed"


def optical_frame(camera: str) -> str:
    """TF frame of a camera's optical axes (REP-103)."""
    return f"{camera}_optical"


# --- results ---

FRAMES_SKIPPED = "frames_skipped"  # std_msgs/Header: a camera's segmentation is behind; all skip up to this stamp
HULL = "hull"  # sensor_msgs/PointCloud2, see cloud_messages.hull_to_cloud
SURFACE = "surface"  # sensor_msgs/PointCloud2 with normals, curvature and geodesic distance, on demand
JOINTS = "joints"  # geometry_msgs/PoseArray, 25 joints in the order of core.pose.JOINT_NAMES
TRUE_JOINTS = "true_joints"  # the same of the first simulated person
MARKERS = "markers"  # visualization_msgs/MarkerArray, stick figure and flesh figure
JOINT_ANGLES = "joint_angles"  # sensor_msgs/JointState, the full native set
DIAGNOSTICS = "/diagnostics"  # diagnostic_msgs/DiagnosticArray
TF = "/tf"  # tf2_msgs/TFMessage
TF_STATIC = "/tf_static"  # the same, for what never moves


def true_joints(person: int) -> str:
    """geometry_msgs/PoseArray of each simulated person, from 1."""
    return TRUE_JOINTS if person == 1 else f"{TRUE_JOINTS}_{person}"


BODIES_TRACKED = "humans/bodies/tracked"  # hri_msgs/IdsList, where hri_msgs is installed


def body_joint_states(body_id: str) -> str:
    """sensor_msgs/JointState of a person with the ROS4HRI joint names (REP-155)."""
    return f"humans/bodies/{body_id}/joint_states"


def body_urdf(body_id: str) -> str:
    """std_msgs/String, latched: the URDF with the fitted lengths."""
    return f"humans/bodies/{body_id}/urdf"


def body_native_urdf(body_id: str) -> str:
    """std_msgs/String, latched: the URDF whose joints are those of JOINT_ANGLES."""
    return f"humans/bodies/{body_id}/native_urdf"


def body_joints(body_id: str) -> str:
    """geometry_msgs/PoseArray: JOINTS of this person."""
    return f"humans/bodies/{body_id}/joints"


def body_joint_angles(body_id: str) -> str:
    """sensor_msgs/JointState: JOINT_ANGLES of this person."""
    return f"humans/bodies/{body_id}/joint_angles"


def body_posture(body_id: str) -> str:
    """Standing, sitting, ...: hri_msgs/BodyPosture, where hri_msgs is installed."""
    return f"humans/bodies/{body_id}/posture"


def body_frame(body_id: str) -> str:
    """TF frame of a person: mid-hips, x forward, z to the head."""
    return f"body_{body_id}"


def patterns(parameter: str, texts: tuple[str, ...]) -> list[re.Pattern[str]]:
    """Regular expressions of topic names; raises ConfigError, naming the parameter, when one is none."""
    try:
        return [re.compile(text) for text in texts]
    except re.error as error:
        raise ConfigError(f"parameter {parameter}: {error.pattern!r} is no regular expression ({error})") from error


# --- services, below the node's own name ---

RECAPTURE_BACKGROUND = "~/recapture_background"  # std_srvs/Trigger
FREEZE_BACKGROUND = "~/freeze_background"  # std_srvs/SetBool

# --- quality of service ---


def _reliable(depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


def image_subscription(reliability: str) -> QoSProfile:
    """`best_effort` (works with every camera) or `reliable`."""
    qos = _reliable(10)
    if reliability == "best_effort":
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
    return qos


#: Everything that is published per frame.
STREAM_QOS = _reliable(5)
#: Masks and hulls on their way into nodes that carve and fit: deep enough for all that comes meanwhile.
WORK_QOS = _reliable(30)
DIAGNOSTICS_QOS = _reliable(10)
#: As tf2_ros has them: what moves, what each publisher keeps of all that does not, and many such publishers heard.
TF_QOS = _reliable(100)
TF_STATIC_SUBSCRIPTION_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
#: Kept for late joiners (the URDF).
LATCHED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
