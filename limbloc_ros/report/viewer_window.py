# SPDX-License-Identifier: Apache-2.0
"""The viewer's window and its pictures, by Open3D (the extra `viewer`); what is shown comes from `viewer_scene`."""

from __future__ import annotations

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
BACKGROUND = (0.96, 0.97, 0.98, 1.0)
#: The hull is glass where the figure inside it is shown too.
_GLASS = 0.35


def load_open3d() -> Any:
    """Open3D; raises InputError when it is not installed."""
    try:
        import open3d
        from open3d.visualization import gui, rendering  # noqa: F401 (their absence should show here)
    except ModuleNotFoundError:
        raise InputError("the viewer needs Open3D; install it with `pip install 'limbloc_ros[viewer]'`") from None
    return open3d


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
        scene.set_lighting(scene.LightingProfile.NO_SHADOWS, (0.4, 0.6, -0.7))

    def show(self, playback: Playback) -> None:
        """Show the playback's frame with what is switched on."""
        for name in self._shown:
            self._scene.remove_geometry(name)
        self._shown.clear()
        meshes = self._run_scene.meshes(playback.number, playback.layers, playback.colour)
        glass = "hull" in meshes and playback.colour == COLOURS[0] and len(meshes) > 1
        for name, mesh in meshes.items():
            self._add(name, to_triangles(self._open3d, mesh), self._material(glass and name == "hull"))
        for name, lines in self._run_scene.lines(playback.layers).items():
            if len(lines.segments):
                material = self._open3d.visualization.rendering.MaterialRecord()
                material.shader, material.line_width = "unlitLine", 2.0
                self._add(name, to_line_set(self._open3d, lines), material)

    def _add(self, name: str, geometry: Any, material: Any) -> None:
        self._scene.add_geometry(name, geometry, material)
        self._shown.add(name)

    def _material(self, glass: bool) -> Any:
        material = self._open3d.visualization.rendering.MaterialRecord()
        material.shader = "defaultLitTransparency" if glass else "defaultLit"
        material.base_color = (1.0, 1.0, 1.0, _GLASS if glass else 1.0)
        material.base_roughness = 0.7
        return material


def view_point(run_scene: RunScene) -> tuple[np.ndarray, np.ndarray]:
    """What to look at, and from where: the middle of the movement, from a little above."""
    joints = run_scene.run.joints
    seen = joints[np.isfinite(joints).all(axis=2)]
    if not len(seen):
        seen = np.stack([run_scene.rig.volume_min, run_scene.rig.volume_max])
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle = (low + high) / 2
    distance = 1.1 * float(np.linalg.norm(high - low)) / (2 * np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)) + 0.4
    return middle, middle + distance * np.array([0.70, 0.62, 0.35])


def write_picture(run_scene: RunScene, playback: Playback, path: Path, size_px: tuple[int, int] = (1280, 960)) -> None:
    """Draw one frame without a window.

    Raises:
        InputError: Open3D is missing or cannot draw here.
        OutputError: the file cannot be written.
    """
    open3d = load_open3d()
    try:
        renderer = open3d.visualization.rendering.OffscreenRenderer(*size_px)
    except RuntimeError as error:
        raise InputError(f"Open3D cannot draw here ({error}); it needs Vulkan, by a graphics card or Mesa") from None
    Stage(open3d, renderer.scene, run_scene).show(playback)
    target, eye = view_point(run_scene)
    renderer.setup_camera(FIELD_OF_VIEW_DEG, target, eye, [0.0, 0.0, 1.0])
    image = np.asarray(renderer.render_to_image())
    done, data = cv2.imencode(path.suffix or ".png", np.ascontiguousarray(image[..., 2::-1]))
    if not done:
        raise InputError(f"{path}: expected a picture such as view.png")
    with replaced(path) as temporary:
        temporary.write_bytes(data.tobytes())


class Window:
    """The window; `run` returns when it is closed.

    Keys: left and right step, space plays, home and end go to the ends.
    """

    def __init__(self, run_scene: RunScene, playback: Playback, title: str) -> None:
        self._open3d = load_open3d()
        self._gui = gui = self._open3d.visualization.gui
        self._run_scene, self._playback = run_scene, playback
        self._app = gui.Application.instance
        self._app.initialize()
        self._window = self._app.create_window(title, 1400, 900)
        em = self._window.theme.font_size
        self._view = gui.SceneWidget()
        self._view.scene = self._open3d.visualization.rendering.Open3DScene(self._window.renderer)
        self._stage = Stage(self._open3d, self._view.scene, run_scene)
        self._panel = gui.Vert(0.5 * em, gui.Margins(0.7 * em))
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
        """Show it until it is closed."""
        self._app.run()

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
        self._panel.add_child(gui.Label("colour of the hull"))
        choice = gui.Combobox()
        for words in COLOURS:
            choice.add_item(words)
        choice.selected_text = playback.colour
        choice.set_on_selection_changed(lambda words, _index: self._colour(words))
        self._panel.add_child(choice)

    def _update(self) -> None:
        self._stage.show(self._playback)
        self._text.text = self._run_scene.text(self._playback.number)
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
        keys = self._gui.KeyName
        if event.type != self._gui.KeyEvent.DOWN:
            return False
        number, last = self._playback.number, self._playback.frames - 1
        goals = {keys.LEFT: number - 1, keys.RIGHT: number + 1, keys.HOME: 0, keys.END: last}
        if event.key == keys.SPACE:
            self._toggle()
        elif event.key in goals:
            self._go(goals[event.key])
        else:
            return False
        return True

    def _on_tick(self) -> bool:
        now = time.monotonic()
        moved = self._playback.tick(now - self._last_s)
        self._last_s = now
        if moved:
            self._update()
        return moved
