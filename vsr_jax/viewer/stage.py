"""The arm in the page: what viser draws in space, in a light and a dark theme."""

from typing import Any

import equinox as eqx
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.typing import ColorType

from ..arm.loads import Gravity
from ..arm.obstacles import Obstacle
from ..arm.scene import Scene
from ..viz.annotate import Row
from ..viz.body import Body
from ..viz.obstacles import COLOR, opacity, polygons_of
from ..viz.space import FRAME_COLORS
from ..viz.style import COLORS, Theme, mixed, settings
from .coloring import BANDS, COLORINGS, Scale
from .description import Shape
from .mesh import ArrowScale, Mesh, bands, discs, polygons, segments, tube, tube_parts, tube_values
from .session import Answer

_FRAME = 0.13
"""Length of the axes of the world's frame, relative to the arm."""
_GRAVITY = np.array([-0.12, 0.0, 0.12])
"""Where the arrow of gravity starts, relative to the arm."""
_FLOOR = 1.1
"""Depth of the floor below the origin, relative to the arm, which does not reach it."""
_VIEW = np.array([0.46, -0.80, 0.37])
"""Direction from the arm to the camera, that of the figures."""
_ANGLE, _DISTANCE, _ASIDE = 0.7, 1.9, 0.25
"""Angle of view [rad]; distance of the camera, and how far the controls at the right move what it
looks at, in extents of the arm."""
_WALL, _WINDOW, _DIMMED, _DISC, _RIGID = 0.8, 0.4, 0.15, 0.25, 0.9
"""Opacity of the wall, of one around coloured threads, of one that is no equilibrium; of discs and
rigid pieces."""
_THREAD = 4.0
"""Width of threads [pixels]."""
_THIN, _WITHIN = 0.012, 0.5
"""Radius of a wall relative to the arm's extent below which it is drawn wider, up to this share of
its discs."""


class Stage:
    """Draws answers into the scene of a viser server.

    **Arguments:** `server`: a `viser.ViserServer`; `length`: of the arm [m].

    **Fields:** `scale`, of the colours; `drawn`, the number of answers that were drawn.
    """

    def __init__(self, server: Any, length: float):
        self._server, self._length = server, length
        self._nodes: dict[str, Any] = {}
        self._arrows = ArrowScale()
        self._factors: tuple[float, float] | None = None
        self._obstacles: tuple[Obstacle, ...] = ()
        self.scale, self.drawn = Scale(COLORINGS["strain"]), 0
        self.theme("light")

    def theme(self, name: Theme) -> None:
        """Switches between light and dark."""
        style = settings(name)
        self._paper, self._ink = style["axes.facecolor"], style["text.color"]
        self._server.gui.configure_theme(
            dark_mode=name == "dark",
            show_logo=False,
            show_share_button=False,
            brand_color=_bytes(COLORS[0]),
        )
        self._frame()

    def color_by(self, name: str) -> None:
        """Selects one of `COLORINGS`."""
        self.scale = Scale(COLORINGS[name])

    @property
    def widening(self) -> float:
        """Factor by which the wall is drawn wider than it is, that of the first shape."""
        return 1.0 if self._factors is None else self._factors[1]

    def draw(self, answer: Answer) -> None:
        """Shows an answer; a shape that is no equilibrium of its setting is dimmed."""
        shape, good = answer.shape, answer.failure is None
        if shape is not None:
            if self._factors is None:
                self._factors = factors(shape.body)
                self._look_at(shape)
            body = shape.body.widened(self._factors[0])
            with self._server.atomic():
                self._draw_wall(shape, good)
                self._draw_discs(body, good)
                self._draw_threads(shape, body, good)
                self._draw_loads(shape, good)
                self._draw_obstacles(shape.equilibrium.scene)
            self._server.flush()
        self.drawn += 1

    def _draw_wall(self, shape: Shape, good: bool) -> None:
        rings = np.asarray(shape.body.widened(self.widening).samples.wall)
        rigid = tube_parts(shape.body.rigid, rings.shape[1])
        wall, held = bands(tube(rings), rigid.astype(int), 2)
        values = self.scale.coloring.values(shape)
        self.scale.cover(values)
        window = self.scale.coloring.of_threads
        opacity = (_WINDOW if window else _WALL) if good else _DIMMED
        self._mesh("/arm/wall/rigid", held, self._gray(0.75), _RIGID if good else _DIMMED)
        if window or not good:
            self._mesh("/arm/wall/plain", wall, self._gray(0.5), opacity)
            parts = [Mesh(wall.vertices[:0], wall.triangles[:0])] * BANDS
        else:
            self._hide("/arm/wall/plain")
            level = self.scale.levels(tube_values(values)[~rigid])
            parts = bands(wall, level, BANDS)
        for i, (part, color) in enumerate(zip(parts, self.scale.colors(), strict=True)):
            self._mesh(f"/arm/wall/{i}", part, color, opacity)

    def _draw_discs(self, body: Body, good: bool) -> None:
        opacity = _DISC if good else _DIMMED
        self._mesh("/arm/discs", discs(body.discs), self._gray(0.5), opacity, side="double")

    def _draw_threads(self, shape: Shape, body: Body, good: bool) -> None:
        slack = np.zeros(len(body.samples.threads), bool) if body.slack is None else body.slack
        points, thread = segments(np.asarray(body.samples.threads), slack)
        color = np.tile(self._gray(0.8 if good else 0.35), (len(slack), 1))
        if good and self.scale.coloring.of_threads:
            values = self.scale.coloring.values(shape)
            there = np.isfinite(values)
            color[there] = self.scale.colors()[self.scale.levels(values[there])]
        colors = np.repeat(color[thread][:, None], 2, axis=1)
        self._lines("/arm/threads", points, colors, _THREAD)

    def _draw_loads(self, shape: Shape, good: bool) -> None:
        rows = shape.loads if good else []
        arrows = self._arrows.arrows(rows, self._length)
        points = np.concatenate([np.zeros((0, 2, 3)), *arrows])
        colors = [
            np.broadcast_to(_bytes(load_color(row)), (len(a), 3))
            for row, a in zip(rows, arrows, strict=True)
        ]
        self._arrow_node("/loads", points, np.concatenate([np.zeros((0, 3)), *colors]), 0.004)
        gravity = [x.acceleration for x in shape.equilibrium.scene.loads if isinstance(x, Gravity)]
        total = np.sum(np.asarray(gravity, float).reshape(-1, 3), axis=0)
        self._gravity(total)

    def _draw_obstacles(self, scene: Scene) -> None:
        """Draws the obstacles where the arm can be, and again where one changes."""
        base = np.zeros(3) if scene.rod.base is None else np.asarray(scene.rod.base)[:3, 3]
        around = base + 0.5 * self._length * np.stack([-np.ones(3), np.ones(3)])
        for i, obstacle in enumerate(scene.obstacles):
            known = self._obstacles[i] if self._obstacles else None
            if not eqx.tree_equal(obstacle, known):
                mesh = polygons(polygons_of(obstacle, around))
                color = _bytes(COLOR)
                self._mesh(f"/obstacles/{i}", mesh, color, opacity(obstacle), side="double")
        self._obstacles = scene.obstacles

    def _frame(self) -> None:
        size = _FRAME * self._length
        start = np.zeros((3, 3))
        ends = size * np.eye(3)
        colors = np.array([_bytes(color) for color in FRAME_COLORS])
        self._arrow_node("/world/frame", np.stack([start, ends], axis=1), colors, 0.005)
        for name, end in zip("xyz", 1.15 * ends, strict=True):
            self._server.scene.add_label(
                f"/world/{name}", name, position=end, anchor="center-center"
            )
        self._server.scene.add_grid(
            "/world/ground",
            width=3 * self._length,
            height=3 * self._length,
            cell_size=self._length / 10,
            section_size=self._length / 2,
            cell_color=self._gray(0.12),
            section_color=self._gray(0.25),
            cell_thickness=0.6,
            section_thickness=0.8,
            position=(0.0, 0.0, -_FLOOR * self._length),
        )

    def _gravity(self, acceleration: np.ndarray) -> None:
        size = float(np.linalg.norm(acceleration))
        if size == 0:
            self._hide("/world/gravity")
            self._hide("/world/g")
            return
        start = _GRAVITY * self._length
        end = start + _FRAME * self._length * acceleration / size
        color = np.array([self._gray(0.7)])
        self._arrow_node("/world/gravity", np.stack([start, end])[None], color, 0.005)
        label = self._nodes.get("/world/g")
        if label is None:
            label = self._nodes["/world/g"] = self._server.scene.add_label("/world/g", "g")
        label.position, label.visible = end, True

    def _look_at(self, shape: Shape) -> None:
        around = self._length * np.stack([1.2 * _FRAME * np.ones(3), np.zeros(3), _GRAVITY])
        points = np.concatenate([shape.body.points, around])
        low, high = points.min(axis=0), points.max(axis=0)
        extent = max(float(np.max(high - low)), self._length)
        right = np.cross((0.0, 0.0, 1.0), _VIEW)
        middle = (low + high) / 2 + _ASIDE * extent * right / np.linalg.norm(right)
        camera = self._server.initial_camera
        camera.position, camera.look_at = middle + _DISTANCE * extent * _VIEW, middle
        camera.up, camera.near, camera.fov = (0.0, 0.0, 1.0), 0.01 * extent, _ANGLE
        for client in self._server.get_clients().values():
            client.camera.fov = camera.fov
            client.camera.position, client.camera.look_at = camera.position, camera.look_at

    def _gray(self, strength: float) -> tuple[int, int, int]:
        return _bytes(mixed(self._paper, self._ink, strength))

    def _mesh(self, name: str, mesh: Mesh, color: Any, opacity: float, side: str = "front") -> None:
        if not len(mesh.triangles):
            self._hide(name)
            return
        node = self._nodes.get(name)
        if node is None:
            self._nodes[name] = self._server.scene.add_mesh_simple(
                name,
                mesh.vertices,
                mesh.triangles,
                color=color,
                opacity=opacity,
                side=side,
                cast_shadow=False,
                receive_shadow=False,
            )
            return
        node.vertices, node.faces = (
            mesh.vertices.astype(np.float32),
            mesh.triangles.astype(np.uint32),
        )
        node.color, node.opacity, node.visible = tuple(int(x) for x in color), opacity, True

    def _lines(self, name: str, points: np.ndarray, colors: np.ndarray, width: float) -> None:
        add = self._server.scene.add_line_segments
        self._colored(add, name, points, colors, thickness=width, thickness_units="screen")

    def _arrow_node(self, name: str, points: np.ndarray, colors: np.ndarray, radius: float) -> None:
        size = radius * self._length
        options = {"shaft_radius": size, "head_radius": 3 * size, "head_length": 8 * size}
        self._colored(self._server.scene.add_arrows, name, points, colors, **options)

    def _colored(
        self, add: Any, name: str, points: np.ndarray, colors: np.ndarray, **options: Any
    ) -> None:
        """Adds a node of segments, or changes the one of that name."""
        if not len(points):
            self._hide(name)
            return
        node = self._nodes.get(name)
        if node is None:
            self._nodes[name] = add(name, points, linear(colors), **options)
            return
        node.points, node.colors = points.astype(np.float32), linear(colors)
        node.visible = True

    def _hide(self, name: str) -> None:
        if name in self._nodes:
            self._nodes[name].visible = False


def factors(body: Body) -> tuple[float, float]:
    """Factors by which an arm is drawn wider to be seen: all of it, and its wall."""
    if body.widening > 1 or not body.discs.size:
        return body.widening, body.widening
    axis = np.asarray(body.samples.position)
    radius = float(np.max(np.linalg.norm(body.samples.wall - axis[:, None], axis=-1)))
    rims = np.linalg.norm(body.discs - body.discs.mean(axis=1, keepdims=True), axis=-1)
    extent = float(np.max(np.ptp(axis, axis=0)))
    wanted = min(_THIN * extent, _WITHIN * float(np.max(rims)))
    return 1.0, float(f"{wanted / radius:.2g}") if radius < wanted else 1.0


def load_color(row: Row) -> str:
    """Colour of the arrows of a load; lines are not dashed here, so that moments have their own."""
    return COLORS[2] if row.moment else row.color


def linear(colors: np.ndarray) -> np.ndarray:
    """Colours as bytes (sRGB) in linear light, which viser expects for lines and arrows, but not
    for meshes."""
    share = np.asarray(colors, float) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * light).astype(np.uint8)


def _bytes(color: ColorType) -> tuple[int, int, int]:
    red, green, blue = (round(255 * x) for x in to_rgb(color))
    return red, green, blue
