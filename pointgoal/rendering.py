"""Pictures of the task from above, drawn without any graphics driver."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pointgoal.layouts import EXTENT
from pointgoal.observation import BIN_WIDTH, HAZARD_RADIUS, LIDAR_BINS, FloatArray
from pointgoal.scene import VASE_SIZE
from pointgoal.simulation import GOAL_RADIUS, Simulation

PICTURE_SIZE = 480
"""Width and height of a picture [pixels]."""
_OVERSAMPLING = 2
_MARGIN = 0.45
_RGB = tuple[int, int, int]

_FLOOR, _TILE = (246, 245, 241), (236, 234, 228)
_INK = (52, 54, 60)
_HAZARD, _GOAL, _VASE = (64, 84, 178), (52, 158, 92), (22, 160, 178)
_ROBOT, _ARROW, _COST = (189, 11, 47), (24, 38, 92), (214, 40, 40)
_LIDAR_RINGS = (("goal_lidar", _GOAL, 0.17), ("hazards_lidar", _HAZARD, 0.215), ("vases_lidar", _VASE, 0.26))


class _Canvas:
    """A picture in world units: metres, y up."""

    def __init__(self, centre: FloatArray, reach: float) -> None:
        self._pixels = PICTURE_SIZE * _OVERSAMPLING
        self._scale = self._pixels / (2 * reach)
        self._corner = np.array([centre[0] - reach, centre[1] + reach])
        self.image = Image.new("RGB", (self._pixels, self._pixels), _FLOOR)
        self._draw = ImageDraw.Draw(self.image, "RGBA")

    def _pixel(self, points: FloatArray) -> list[tuple[float, float]]:
        offset = (np.atleast_2d(points) - self._corner) * [self._scale, -self._scale]
        return [(float(x), float(y)) for x, y in offset]

    def tiles(self, size: float) -> None:
        """A checkerboard of the given tile size [m], fixed to the world."""
        reach = self._pixels / self._scale
        x0, y1 = self._corner
        for i in range(int(np.floor(x0 / size)), int(np.ceil((x0 + reach) / size))):
            for j in range(int(np.floor((y1 - reach) / size)), int(np.ceil(y1 / size))):
                if (i + j) % 2:
                    low = np.array([i, j]) * size
                    self.polygon(low + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), _TILE)

    def disc(
        self, centre: FloatArray, radius: float, fill: _RGB, opacity: float = 1.0, rim: float = 0.0
    ) -> None:
        """A disc [m]; with a rim, its outline is drawn that wide [m]."""
        ((x, y),) = self._pixel(centre)
        r = radius * self._scale
        outline = (*fill, 255) if rim else None
        box = (x - r, y - r, x + r, y + r)
        self._draw.ellipse(box, (*fill, round(255 * opacity)), outline, round(rim * self._scale))

    def polygon(self, points: FloatArray, fill: _RGB, opacity: float = 1.0) -> None:
        """A filled polygon (k, 2) [m]."""
        self._draw.polygon(self._pixel(points), (*fill, round(255 * opacity)))

    def text(self, text: str, fill: _RGB) -> None:
        """One line in the upper left corner."""
        font = ImageFont.load_default(size=15 * _OVERSAMPLING)
        self._draw.text((10 * _OVERSAMPLING, 7 * _OVERSAMPLING), text, fill=fill, font=font)

    def frame(self, colour: _RGB, width: int) -> None:
        """A frame of the given width [pixels]."""
        last = self._pixels - 1
        self._draw.rectangle((0, 0, last, last), outline=colour, width=width * _OVERSAMPLING)


def draw(simulation: Simulation, row: int, cost: float) -> np.ndarray:
    """Draw one robot's surroundings from above.

    Hazards are blue, the goal green, vases teal. Around the robot run the lidar rings, one dot a bin, the
    more opaque the nearer. A step with cost has a red halo and frame.

    Args:
        simulation: whose state to draw.
        row: which of its robots.
        cost: the last step's cost.

    Returns:
        (480, 480, 3) uint8.
    """
    pose = simulation.pose[row]
    position, heading = pose[:2], float(pose[2])
    reach = EXTENT[simulation.level] + _MARGIN
    edge = reach - 0.3
    canvas = _Canvas(position - np.clip(position, -edge, edge), reach)
    canvas.tiles(0.5)
    canvas.disc(simulation.goal[row], GOAL_RADIUS, _GOAL, 0.35, rim=0.015)
    for hazard in simulation.hazards[row]:
        canvas.disc(hazard, HAZARD_RADIUS, _HAZARD, 0.35, rim=0.015)
    for vase in simulation.vases[row]:
        yaw = 2 * np.arctan2(vase[6], vase[3])
        canvas.polygon(vase[:2] + _box(VASE_SIZE, yaw), _VASE, 0.9)
    if cost > 0:
        canvas.disc(position, 0.32, _COST, 0.15, rim=0.02)
    _draw_robot(canvas, position, heading)
    observation = simulation.observe()[row]
    for name, colour, radius in _LIDAR_RINGS:
        if name in simulation.layout:
            readings = observation[simulation.layout.slice(name)]
            _draw_lidar(canvas, position, heading, readings, colour, radius)
    state = f"step {simulation.elapsed_steps[row]}   cost {cost:.3f}"
    canvas.text(state, _COST if cost > 0 else _INK)
    if cost > 0:
        canvas.frame(_COST, 4)
    image = canvas.image.resize((PICTURE_SIZE, PICTURE_SIZE), Image.Resampling.LANCZOS)
    return np.asarray(image)


def _draw_robot(canvas: _Canvas, position: FloatArray, heading: float) -> None:
    ahead = np.array([np.cos(heading), np.sin(heading)])
    canvas.disc(position, 0.1, _ROBOT)
    canvas.polygon(position + 0.1 * ahead + _box(0.05, heading), _ARROW)
    canvas.disc(position, 0.02, _FLOOR)


def _draw_lidar(
    canvas: _Canvas, position: FloatArray, heading: float, readings: FloatArray, colour: _RGB, radius: float
) -> None:
    angles = heading + (np.arange(LIDAR_BINS) + 0.5) * BIN_WIDTH
    for angle, reading in zip(angles, readings, strict=True):
        dot = position + radius * np.array([np.cos(angle), np.sin(angle)])
        canvas.disc(dot, 0.021, colour, 0.15 + 0.85 * float(reading))


def _box(half: float, yaw: float) -> FloatArray:
    """(4, 2) corners of a square around the origin, turned by yaw [rad]."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    turned: FloatArray = corners @ np.array([[cos, sin], [-sin, cos]])
    return turned
