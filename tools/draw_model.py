# SPDX-License-Identifier: Apache-2.0
"""Draw docs/images/model.png: flesh figure, stick figure with joint names, and a bent posture with its frames.

python tools/draw_model.py docs/images/model.png
"""

from __future__ import annotations

import sys

import cv2
import numpy as np

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.figure import BONE_NAMES, FigureState, Placed, place
from limbloc_ros.core.joint_angles import NATIVE_ANGLES, native_rotations
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.export.stick_drawing import side_of
from limbloc_ros.report.mesh import Mesh, capsule, flesh_figure_mesh, stick_mesh
from limbloc_ros.report.renderer import Layer, look_at, render

SIZE_PX = (760, 1000)
AXIS_COLOURS = ((0.85, 0.15, 0.12), (0.15, 0.62, 0.20), (0.15, 0.30, 0.85))


def posed(**degrees: float) -> Placed:
    """Someone of 1.7 m who stands on the floor and bends the joints named."""
    angles = {angle.name: np.radians(degrees.get(angle.name, 0.0)) for angle in NATIVE_ANGLES}
    standing = FigureState.standing(np.zeros(3))
    placed = place(FigureState(np.zeros(3), native_rotations(angles), standing.shape))
    floor = (placed.spheres[:, 2] - placed.radii).min()
    return place(FigureState(np.array([0.0, 0.0, -floor]), native_rotations(angles), standing.shape))


def bone_axes(placed: Placed, length_m: float = 0.09) -> Mesh:
    """x red, y green, z blue at the origin of every bone."""
    rods = []
    for origin, rotation in zip(placed.origins, placed.rotations, strict=True):
        for axis, colour in zip(rotation.T, AXIS_COLOURS, strict=True):
            rods.append(capsule(origin, origin + length_m * axis, 0.006, 0.003, colour))
    return Mesh.join(rods)


def glass(placed: Placed) -> Layer:
    """The flesh as a faint shell around what matters."""
    return Layer(flesh_figure_mesh(placed.flesh()), opacity=0.12, edge_opacity=0.4, outlined=False)


def label(image: np.ndarray, text: str, at: tuple[int, int], scale: float = 0.5) -> None:
    """Black text with a light rim; the text's left middle at `at`."""
    at = (at[0], at[1] + int(10 * scale))
    for colour, width in (((248, 248, 248), 4), ((30, 30, 30), 1)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, width, cv2.LINE_AA)


def name_points(image: np.ndarray, camera: Camera, points: np.ndarray, names: tuple[str, ...], shown: set[str]) -> None:
    """Names beside the points, away from the middle of the figure."""
    pixels, _ = camera.world_to_image(points)
    middle = float(np.median(pixels[:, 0]))
    for name, (u, v) in zip(names, pixels, strict=True):
        if name in shown:
            width = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0]
            label(image, name, (round(u) + 16 if u >= middle - 4 else round(u) - width - 16, round(v)))


def main() -> None:
    apart = {f"shoulder_{side}_abduction": 38.0 for side in "LR"} | {f"hip_{side}_abduction": 9.0 for side in "LR"}
    standing = posed(**apart)
    bent = posed(
        shoulder_L_abduction=45, elbow_L_flexion=75, shoulder_R_abduction=75, elbow_R_flexion=60,
        shoulder_R_rotation=70, hip_L_abduction=12, hip_L_flexion=35, knee_L_flexion=50, hip_R_abduction=6,
        neck_rotation=25,
    )  # fmt: skip
    front = look_at([0, 0, 0.84], 0.0, 0.06, 4.0, SIZE_PX)
    oblique = look_at([0.05, 0, 0.82], np.radians(22), 0.1, 4.0, SIZE_PX)
    aside = look_at([0, 0, 0.84], 0.5, 0.12, 4.0, SIZE_PX)
    flesh = render([Layer(flesh_figure_mesh(standing.flesh()))], aside, floor=True)
    stick = render([glass(standing), Layer(stick_mesh(standing.joints))], front, floor=True)
    frames = render([glass(bent), Layer(bone_axes(bent))], oblique, floor=True)
    flesh, stick, frames = pictures = [np.ascontiguousarray(image) for image in (flesh, stick, frames)]

    middle = {name for name in JOINT_NAMES if not side_of(name)}
    name_points(stick, front, standing.joints, JOINT_NAMES, middle | {n for n in JOINT_NAMES if side_of(n) == "L"})
    limbs = {b for b in BONE_NAMES if side_of(b) == "L"} | {"pelvis", "thorax", "chest", "head"}
    name_points(frames, oblique, bent.origins, BONE_NAMES, limbs)
    titles = ("flesh figure", "stick figure and the 25 joints", "bones: x red, y green, z blue")
    for image, title in zip(pictures, titles, strict=True):
        label(image, title, (20, 30), 0.75)
    sheet = cv2.resize(np.hstack(pictures), None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
    cv2.imwrite(sys.argv[1], cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
