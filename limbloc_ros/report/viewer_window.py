# SPDX-License-Identifier: Apache-2.0
"""The viewer's window and its pictures, by Open3D (the extra `viewer`); what is shown comes from `viewer_scene`."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from limbloc_ros.core.errors import InputError
from limbloc_ros.files import replaced
from limbloc_ros.report.mesh import Mesh
from limbloc_ros.report.viewer_scene import COLOURS, LAYERS, Lines, Playback, RunScene

FIELD_OF_VIEW_DEG = 50.0
#: So much further away than where all that is looked at would just fit, m: flesh is outside of the joints.
MARGIN_M = 0.6
#: The most that `RunScene.text` says of a frame.
TEXT_LINES = 4
BACKGROUND = (0.96, 0.97, 0.98, 1.0)
#: Colours as they are. Of the materials of Open3D that show them this is the only one without textures, which cost
#: Mesa's software driver seconds in each picture (16 s for a lit one), even if there are none.
SHADER = "unlitPolygonOffset"


class _InstanceCreateInfo(ctypes.Structure):
    """Vulkan's VkInstanceCreateInfo, without layers or extensions."""

    _fields_ = (
        ("sType", ctypes.c_uint32),
        ("pNext", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("pApplicationInfo", ctypes.c_void_p),
        ("enabledLayerCount", ctypes.c_uint32),
        ("ppEnabledLayerNames", ctypes.c_void_p),
        ("enabledExtensionCount", ctypes.c_uint32),
        ("ppEnabledExtensionNames", ctypes.c_void_p),
    )


def load_open3d() -> Any:
    """Open3D; raises InputError when it is not installed or cannot draw here."""
    try:
        import open3d
        from open3d.visualization import gui, rendering  # noqa: F401 (their absence should show here)
    except ModuleNotFoundError:
        raise InputError("the viewer needs Open3D; install it with `pip install 'limbloc_ros[viewer]'`") from None
    by_vulkan = sys.platform == "linux" and [int(n) for n in open3d.__version__.split(".")[:2]] >= [0, 20]
    if by_vulkan and not has_vulkan():
        raise InputError(
            "Open3D draws with Vulkan, and no driver for it is installed here; without a graphics card Mesa's does: "
            "`apt install mesa-vulkan-drivers`"
        )
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def require_display() -> None:
    """Raises InputError when there is nothing to show a window on; Open3D would wait for it without an end."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "there is no display for a window (DISPLAY is not set); `--picture FILE` draws one frame without any"
        )


def has_vulkan() -> bool:
    """Whether a Vulkan driver with a device is installed: Open3D would take the process down with it if not."""
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return False
    instance, devices = ctypes.c_void_p(), ctypes.c_uint32()
    create = _InstanceCreateInfo(sType=1)
    if vulkan.vkCreateInstance(ctypes.byref(create), None, ctypes.byref(instance)) != 0:
        return False
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(devices), None)
    vulkan.vkDestroyInstance(instance, None)
    return devices.value > 0


def to_triangles(open3d: Any, mesh: Mesh) -> Any:
    """A mesh as Open3D's, with its normals and colours."""
    found = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )
    found.vertex_normals = open3d.utility.Vector3dVector(mesh.normals)
    found.vertex_colors = open3d.utility.Vector3dVector(mesh.colours)
    return found


def to_line_set(open3d: Any, lines: Lines) -> Any:
    """Lines as Open3D's."""
    found = open3d.geometry.LineSet(
        open3d.utility.Vector3dVector(lines.points), open3d.utility.Vector2iVector(lines.segments.astype(np.int32))
    )
    found.paint_uniform_color(lines.colour)
    return found


class Stage:
    """An Open3D scene that is brought up to date with the playback."""

    def __init__(self, open3d: Any, scene: Any, run_scene: RunScene) -> None:
        self._open3d, self._scene, self._run_scene = open3d, scene, run_scene
        self._shown: set[str] = set()
        scene.set_background(BACKGROUND)
        scene.view.set_post_processing(False)  # it would wash out the colours, which mean something

    def show(self, playback: Playback) -> None:
        """Show the playback's frame with what is switched on."""
        for name in self._shown:
            self._scene.remove_geometry(name)
        self._shown.clear()
        shapes = self._run_scene.shapes(playback.number, playback.layers, playback.colour)
        for name, shape in (shapes | self._run_scene.lines(playback.layers)).items():
            material = self._open3d.visualization.rendering.MaterialRecord()
            if isinstance(shape, Mesh):
                material.shader = SHADER
                self._add(name, to_triangles(self._open3d, shape), material)
            elif len(shape.segments):
                material.shader = "unlitLine"
                material.line_width = 1.0 if name == "hull" else 2.0
                self._add(name, to_line_set(self._open3d, shape), material)

    def _add(self, name: str, geometry: Any, material: Any) -> None:
        self._scene.add_geometry(name, geometry, material)
        self._shown.add(name)


def view_point(run_scene: RunScene, playback: Playback | None = None) -> tuple[np.ndarray, np.ndarray]:
    """What to look at, and from where, a little above: the whole movement, or what the playback's frame shows."""
    joints = run_scene.run.joints
    if playback is not None and "path" not in playback.layers:
        joints = joints[playback.number : playback.number + 1]
    points = joints[np.isfinite(joints).all(axis=2)]
    if playback is not None and "cameras" in playback.layers:
        points = np.concatenate([points, [camera.T_world_camera[:3, 3] for camera in run_scene.rig.cameras]])
    if not len(points):
        points = np.stack([run_scene.rig.volume_min, run_scene.rig.volume_max])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    towards_eye = np.array([0.70, 0.62, 0.35]) / np.linalg.norm([0.70, 0.62, 0.35])
    nearer = (points - middle) @ towards_eye
    aside = np.linalg.norm(points - middle - nearer[:, None] * towards_eye, axis=1)
    distance = float((nearer + aside / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)).max()) + MARGIN_M
    return middle, middle + distance * towards_eye


def write_picture(run_scene: RunScene, playback: Playback, path: Path, size_px: tuple[int, int] = (1280, 960)) -> None:
    """Draw one frame without a window.

    Raises:
        InputError: Open3D is missing or cannot draw here.
        OutputError: the file cannot be written.
    """
    open3d = load_open3d()
    renderer = open3d.visualization.rendering.OffscreenRenderer(*size_px)
    Stage(open3d, renderer.scene, run_scene).show(playback)
    target, eye = view_point(run_scene, playback)
    renderer.setup_camera(FIELD_OF_VIEW_DEG, target, eye, [0.0, 0.0, 1.0])
    image = np.asarray(renderer.render_to_image())
    done, data = cv2.imencode(path.suffix or ".png", np.ascontiguousarray(image[..., 2::-1]))
    if not done:
        raise InputError(f"{path}: expected a picture such as view.png")
    with replaced(path) as temporary:
        temporary.write_bytes(data.tobytes())


class Window:
    """The window; `run` returns when it is closed. `require_display` tells whether there can be one.

    Keys: left and right step, space plays, home and end go to the ends.

    Raises:
        InputError: Open3D is missing or cannot draw here.
    """

    def __init__(self, run_scene: RunScene, playback: Playback, title: str) -> None:
        self._open3d = load_open3d()
        self._gui = gui = self._open3d.visualization.gui
        self._run_scene, self._playback = run_scene, playback
        keys = gui.KeyName
        self._keys = {
            keys.LEFT: "left",
            keys.RIGHT: "right",
            keys.HOME: "home",
            keys.END: "end",
            keys.SPACE: "space",
        }
        self._app = gui.Application.instance
        self._app.initialize()
        self._window = self._app.create_window(title, 1400, 900)
        em = self._window.theme.font_size
        self._view = gui.SceneWidget()
        self._view.scene = self._open3d.visualization.rendering.Open3DScene(self._window.renderer)
        self._stage = Stage(self._open3d, self._view.scene, run_scene)
        margin = 0.7 * em
        self._panel = gui.Vert(0.5 * em, gui.Margins(margin, margin, margin, margin))
        self._fill_panel()
        self._window.add_child(self._view)
        self._window.add_child(self._panel)
        self._window.set_on_layout(self._on_layout)
        self._window.set_on_key(self._on_key)
        self._window.set_on_tick_event(self._on_tick)
        self._last_s = time.monotonic()
        target, eye = view_point(run_scene)
        self._view.setup_camera(FIELD_OF_VIEW_DEG, self._bounds(), target)
        self._view.look_at(target, eye, [0.0, 0.0, 1.0])
        self._update()

    def run(self) -> None:
        """Show it until it is closed, or until Ctrl-C, which must not come out of one of Open3D's callbacks."""
        earlier = signal.signal(
            signal.SIGINT, lambda *_: self._app.post_to_main_thread(self._window, self._window.close)
        )
        try:
            self._app.run()
        finally:
            signal.signal(signal.SIGINT, earlier)

    def _bounds(self) -> Any:
        low, high = self._run_scene.rig.volume_min, self._run_scene.rig.volume_max
        return self._open3d.geometry.AxisAlignedBoundingBox(low, high)

    def _fill_panel(self) -> None:
        gui, playback = self._gui, self._playback
        self._text = gui.Label("")
        self._slider = gui.Slider(gui.Slider.INT)
        self._slider.set_limits(0, max(1, playback.frames - 1))
        self._slider.set_on_value_changed(lambda value: self._go(int(value)))
        self._button = gui.Button("play")
        self._button.set_on_clicked(self._toggle)
        self._panel.add_child(self._text)
        self._panel.add_child(self._slider)
        self._panel.add_child(self._button)
        for name, words in LAYERS.items():
            box = gui.Checkbox(words)
            box.checked = name in playback.layers
            box.set_on_checked(lambda on, layer=name: self._switch(layer, on))
            self._panel.add_child(box)
        self._panel.add_child(gui.Label("colour of the hull\n(any but plain hides the figure)"))
        choice = gui.Combobox()
        for words in COLOURS:
            choice.add_item(words)
        choice.selected_text = playback.colour
        choice.set_on_selection_changed(lambda words, _index: self._colour(words))
        self._panel.add_child(choice)

    def _update(self) -> None:
        self._stage.show(self._playback)
        text = self._run_scene.text(self._playback.number)
        self._text.text = text + "\n" * (TEXT_LINES - 1 - text.count("\n"))  # else the label keeps its first height
        self._slider.int_value = self._playback.number
        self._button.text = "pause" if self._playback.playing else "play"
        self._view.force_redraw()

    def _go(self, number: int) -> None:
        self._playback.go(number)
        self._update()

    def _toggle(self) -> None:
        self._playback.toggle()
        self._update()

    def _switch(self, layer: str, on: bool) -> None:
        self._playback.switch(layer, on)
        self._update()

    def _colour(self, words: str) -> None:
        self._playback.colour = words
        self._update()

    def _on_layout(self, context: Any) -> None:
        whole = self._window.content_rect
        width = 20 * context.theme.font_size
        self._view.frame = self._gui.Rect(whole.x, whole.y, whole.width - width, whole.height)
        self._panel.frame = self._gui.Rect(whole.get_right() - width, whole.y, width, whole.height)

    def _on_key(self, event: Any) -> bool:
        if event.type != self._gui.KeyEvent.Type.DOWN or not self._playback.press(self._keys.get(event.key, "")):
            return False
        self._update()
        return True

    def _on_tick(self) -> bool:
        now = time.monotonic()
        moved = self._playback.tick(now - self._last_s)
        self._last_s = now
        if moved:
            self._update()
        return moved
