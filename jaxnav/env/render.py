"""Pictures of episodes as arrays of pixels and as text, with NumPy alone.

`SceneRenderer` draws the plan of a scene once and the agent into a copy of it for each frame. The colors, the floor and
the view cone also serve the figures of `jaxnav.viz`, and the rows of characters the map of `jaxnav play`.
"""

from collections.abc import Sequence

import numpy as np

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE, Scene, scene_extent
from jaxnav.scenes.tables.observation_row import MAX_RANGE
from jaxnav.scenes.tables.visibility import cell_centres, is_opaque
from jaxnav.scenes.task import Rules, Task
from jaxnav.scenes.worlds import Scenes

# Colors of a plan.
BACKGROUND_COLOR = "#f7f5f1"
FLOOR_COLOR = "#ebe5d8"
WALL_COLOR = "#55524d"
ROOM_TINTS = ("#f3d9b8", "#c9e0ee", "#cbe6dc", "#eed3e2", "#f1ecb9", "#d6d4ee")  # pale colors of the palette

# From Okabe and Ito's palette, which stays distinct under the common colour-vision deficiencies.
GOAL_COLOR = "#D55E00"
AGENT_COLOR = "#0072B2"
SEEN_COLOR = "#009E73"

#: Boxes are shaded by the height of their tops, from 0 m to this height in metres; higher boxes are no darker.
FULL_SHADE_HEIGHT = 2.0
#: Colors of the lowest and of the highest boxes.
HEIGHT_COLORS = ("#ddd5c5", "#7f7566")
#: Opacity of the view cone.
CONE_OPACITY = 0.16

# Characters of a map; the agent is an arrow by its heading, clockwise from up.
WALL_CHARACTER = "█"
FLOOR_CHARACTER = "·"
FURNITURE_CHARACTER = "░"
PATH_CHARACTER = "•"
GOAL_CHARACTER = "★"
_AGENT_CHARACTERS = "↑↗→↘↓↙←↖"


def parse_color(color: str) -> np.ndarray:
    """Return red, green and blue of a color such as `#ebe5d8`, float64 [3], from 0 to 1."""
    return np.array(list(bytes.fromhex(color.removeprefix("#")))) / 255


def floor_colors(scene: Scene) -> np.ndarray:
    """Return the colors of the cells, float64 [nz, nx, 3]; standable floor is darker than the rest."""
    colors = np.array([parse_color(FLOOR_COLOR), parse_color(BACKGROUND_COLOR)])[np.where(scene.reach, 0, 1)]
    # Types of rooms have tints in alphabetical order; furniture stands on a paler floor.
    room_types = sorted({room.type for room in scene.rooms})
    for room in scene.rooms:
        room_tint = parse_color(ROOM_TINTS[room_types.index(room.type) % len(ROOM_TINTS)])
        colors[room.cells & scene.reach] = room_tint
        colors[room.cells & ~scene.reach] = (room_tint + parse_color(BACKGROUND_COLOR)) / 2
    colors[scene.walls] = parse_color(WALL_COLOR)
    return colors


def view_cone(scene: Scene, rules: Rules, place: np.ndarray, yaw: float) -> np.ndarray:
    """Return the outline of the visible floor of a level view.

    The cone is 5 m deep and ends at walls and at opaque boxes as high as the camera.

    Returns:
      float64 [N, 2], world (x, z), `place` first.
    """
    # Points along each ray: [401 distances, 81 rays, 2].
    ray_angles = np.deg2rad(yaw + rules.field_of_view[0] * np.linspace(-0.5, 0.5, 81))
    ray_distances = np.linspace(0.0, MAX_RANGE, 401)
    ray_directions = np.stack([np.sin(ray_angles), np.cos(ray_angles)], axis=-1)
    points = place + ray_distances[:, None] * ray_directions[:, None]

    # Mark the points in walls; points outside the grid are free.
    cells = np.rint((points - scene.origin) / CELL_SIZE).astype(int)[..., ::-1]
    last_cell = np.array(scene.walls.shape) - 1
    iz, ix = np.moveaxis(np.clip(cells, 0, last_cell), -1, 0)
    is_inside_grid = (cells == np.stack([iz, ix], axis=-1)).all(axis=-1)
    is_blocked = scene.walls[iz, ix] & is_inside_grid

    # Mark the points in boxes that are as high as the camera and within reach of a ray.
    box_top = scene.boxes[:, 1] + scene.boxes[:, 4] / 2
    box_distance = np.abs(scene.boxes[:, [0, 2]] - place) - scene.boxes[:, [3, 5]] / 2
    is_in_range = (box_distance <= MAX_RANGE).all(axis=1)
    for box in scene.boxes[is_opaque(scene.boxes) & (box_top >= rules.camera) & is_in_range]:
        low_x, low_z = box[[0, 2]] - box[[3, 5]] / 2
        high_x, high_z = box[[0, 2]] + box[[3, 5]] / 2
        x, z = points[..., 0], points[..., 1]
        is_blocked |= (x > low_x) & (x < high_x) & (z > low_z) & (z < high_z)

    # Each ray ends at its first blocked point, or at the end of the range.
    depth = np.where(is_blocked.any(axis=1), is_blocked.argmax(axis=1), len(ray_distances) - 1)
    return np.concatenate([place[None], points[np.arange(len(ray_angles)), depth]])


def plan_characters(scene: Scene) -> np.ndarray:
    """Return the characters of walls, standable floor and furniture, str [nz, nx]; row 0 has the smallest z."""
    return np.where(scene.walls, WALL_CHARACTER, np.where(scene.reach, FLOOR_CHARACTER, FURNITURE_CHARACTER))


def goal_places(scene: Scene, task: Task, goal: int) -> np.ndarray:
    """Return the world positions (x, z) of the objects of a category, by name or alias, float64 [N, 2]."""
    is_goal = np.array(category_ids(scene.types, task.categories), int) == goal
    return scene.boxes[is_goal][:, [0, 2]]


def goal_cells(scene: Scene, task: Task, goal: int) -> np.ndarray:
    """Return the cells (z, x) of the objects of a category inside the grid, int [N, 2]."""
    places = goal_places(scene, task, goal)
    cells = np.rint((places - scene.origin) / CELL_SIZE).astype(int)[:, ::-1]
    return cells[((cells >= 0) & (cells < scene.walls.shape)).all(axis=1)]


class SceneRenderer:
    """Pictures of episodes in one scene.

    Attributes:
      scene: the scene.
      task: categories and rules.
    """

    def __init__(self, scene: Scene, task: Task) -> None:
        self.scene = scene
        self.task = task
        self._cells = standable_cells(scene.reach)
        self._centres = cell_centres(scene, self._cells)
        self._plans: dict[int, np.ndarray] = {}  # by size
        self._outlines: dict[tuple[float, ...], np.ndarray] = {}
        self._low_corner, self._high_corner = scene_extent(scene)

    @property
    def num_cells(self) -> int:
        """Number of cells on which the agent can stand."""
        return len(self._cells)

    def draw_pixels(self, cells: Sequence[int], heading: int, goal: int, size: int) -> np.ndarray:
        """Draw the agent at the end of a path.

        Args:
          cells: indices of cells among those of the scene, from the start of the path to the agent.
          heading: index of the heading.
          goal: category to search for, whose objects are marked.
          size: pixels along the longer side.

        Returns:
          uint8 [height, width, 3]; +z is up.
        """
        # The plan is drawn once.
        if size not in self._plans:
            self._plans[size] = self._draw_plan(size)
        pixels = self._plans[size].copy()
        scale = self._pixels_per_metre(size)
        places = self._centres[list(cells)]
        yaw = 360.0 / self.task.rules.headings * heading

        self._blend_cone(pixels, places[-1], yaw, scale)
        for place in goal_places(self.scene, self.task, goal):
            self._fill_star(pixels, place, scale)
        for place in places[:-1]:
            self._fill_disc(pixels, place, 0.05, scale)
        self._fill_arrow(pixels, places[-1], yaw, scale)
        return pixels

    def draw_text(self, cells: Sequence[int], heading: int, goal: int) -> str:
        """Draw the agent at the end of a path as text; see `draw_pixels`."""
        rows = plan_characters(self.scene)
        goal_name = self.task.categories[goal]
        rows[tuple(goal_cells(self.scene, self.task, goal).T)] = GOAL_CHARACTER
        rows[tuple(self._cells[list(cells)].T)] = PATH_CHARACTER
        direction = round(8 * heading / self.task.rules.headings) % 8
        rows[tuple(self._cells[cells[-1]])] = _AGENT_CHARACTERS[direction]

        # Characters are about twice as high as wide.
        lines = [" ".join(row) for row in rows[::-1].tolist()]
        return "\n".join([f"looking for {goal_name} ({GOAL_CHARACTER})", *lines])

    def _pixels_per_metre(self, size: int) -> float:
        return size / float((self._high_corner - self._low_corner).max())

    def _pixel_places(self, rows: slice, columns: slice, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """World x [width] and z [height] of the centres of pixels."""
        x = self._low_corner[0] + (np.arange(columns.start, columns.stop) + 0.5) / scale
        z = self._high_corner[1] - (np.arange(rows.start, rows.stop) + 0.5) / scale
        return x, z

    def _window(self, pixels: np.ndarray, place: np.ndarray, radius: float, scale: float) -> tuple[slice, slice]:
        """Rows and columns of the pixels within a square of half side `radius`, metres, around a place."""
        column, row = (place[0] - self._low_corner[0]) * scale, (self._high_corner[1] - place[1]) * scale
        height, width, _ = pixels.shape
        rows = slice(max(int(row - radius * scale), 0), min(int(row + radius * scale) + 2, height))
        columns = slice(max(int(column - radius * scale), 0), min(int(column + radius * scale) + 2, width))
        return rows, columns

    def _draw_plan(self, size: int) -> np.ndarray:
        """Draw floor, walls and furniture, the highest boxes on top."""
        scene = self.scene
        scale = self._pixels_per_metre(size)
        width, height = np.maximum(np.rint((self._high_corner - self._low_corner) * scale).astype(int), 1)
        x, z = self._pixel_places(slice(0, height), slice(0, width), scale)

        # Each pixel has the color of its cell; objects may lie outside the grid.
        ix = np.rint((x - scene.origin[0]) / CELL_SIZE).astype(int)
        iz = np.rint((z - scene.origin[1]) / CELL_SIZE).astype(int)
        num_rows, num_columns = scene.walls.shape
        is_inside = ((iz >= 0) & (iz < num_rows))[:, None] & ((ix >= 0) & (ix < num_columns))
        cell_colors = floor_colors(scene)[np.clip(iz, 0, num_rows - 1)][:, np.clip(ix, 0, num_columns - 1)]
        colors = np.where(is_inside[..., None], cell_colors, parse_color(BACKGROUND_COLOR))

        # Boxes with a white edge of one pixel.
        lowest_color, highest_color = map(parse_color, HEIGHT_COLORS)
        box_tops = scene.boxes[:, 1] + scene.boxes[:, 4] / 2
        for box_index in np.argsort(box_tops):
            box_x, _, box_z, size_x, _, size_z = scene.boxes[box_index]
            shade = np.clip(box_tops[box_index] / FULL_SHADE_HEIGHT, 0.0, 1.0)
            box_color = lowest_color + shade * (highest_color - lowest_color)
            for margin, color in ((0.0, np.ones(3)), (1.0 / scale, box_color)):
                rows = np.abs(z - box_z) <= size_z / 2 - margin
                columns = np.abs(x - box_x) <= size_x / 2 - margin
                colors[np.ix_(rows, columns)] = color

        return np.rint(255 * colors).astype(np.uint8)

    def _cone_outline(self, place: np.ndarray, yaw: float) -> np.ndarray:
        """Outline of the view cone, which is computed once for each pose."""
        pose = (*place.tolist(), yaw)
        if pose not in self._outlines:
            self._outlines[pose] = view_cone(self.scene, self.task.rules, place, yaw)
        return self._outlines[pose]

    def _blend_cone(self, pixels: np.ndarray, place: np.ndarray, yaw: float, scale: float) -> None:
        """Tint the floor in view."""
        outline = self._cone_outline(place, yaw)
        depths = np.linalg.norm(outline[1:] - place, axis=1).astype(np.float32)

        # Pixels around the outline, and their places ahead and to the right of the agent.
        middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
        half_sizes = (outline.max(axis=0) - outline.min(axis=0)) / 2
        rows, _ = self._window(pixels, middle, half_sizes[1], scale)
        _, columns = self._window(pixels, middle, half_sizes[0], scale)
        x, z = self._pixel_places(rows, columns, scale)
        offset_x = (x - place[0]).astype(np.float32)
        offset_z = (z - place[1]).astype(np.float32)[:, None]
        sine, cosine = np.float32(np.sin(np.deg2rad(yaw))), np.float32(np.cos(np.deg2rad(yaw)))
        ahead = offset_x * sine + offset_z * cosine
        right = offset_x * cosine - offset_z * sine

        # The ray nearest to every pixel, and the pixels nearer than its end.
        half_view = np.float32(np.deg2rad(self.task.rules.field_of_view[0]) / 2)
        bearing = np.arctan2(right, ahead)
        position = (bearing / half_view + 1) / 2
        ray = np.clip(np.rint(position * (len(depths) - 1)), 0, len(depths) - 1).astype(np.int32)
        in_view = (np.abs(bearing) <= half_view) & (ahead**2 + right**2 <= depths[ray] ** 2)
        _blend(pixels[rows, columns], in_view, AGENT_COLOR, CONE_OPACITY)

    def _fill_disc(self, pixels: np.ndarray, place: np.ndarray, radius: float, scale: float) -> None:
        rows, columns = self._window(pixels, place, radius, scale)
        x, z = self._pixel_places(rows, columns, scale)
        _blend(pixels[rows, columns], np.hypot(x - place[0], (z - place[1])[:, None]) <= radius, AGENT_COLOR, 1.0)

    def _fill_star(self, pixels: np.ndarray, place: np.ndarray, scale: float) -> None:
        """Fill a star with five points in the color of goals, on white."""
        for radius, color in ((0.24, "#ffffff"), (0.19, GOAL_COLOR)):
            angles = np.deg2rad(36 * np.arange(10))
            lengths = radius * np.where(np.arange(10) % 2, 0.45, 1.0)
            corners = place + lengths[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=-1)
            self._fill_polygon(pixels, corners, color, scale)

    def _fill_arrow(self, pixels: np.ndarray, place: np.ndarray, yaw: float, scale: float) -> None:
        """Fill an arrow in the color of agents, on white."""
        angle = np.deg2rad(yaw)
        forward = np.array([np.sin(angle), np.cos(angle)])
        rightward = np.array([forward[1], -forward[0]])
        for size, color in ((0.27, "#ffffff"), (0.21, AGENT_COLOR)):
            corners = []
            for right, ahead in ((0, 1), (0.75, -0.9), (0, -0.45), (-0.75, -0.9)):
                corners.append(place + size * (right * rightward + ahead * forward))
            self._fill_polygon(pixels, np.array(corners), color, scale)

    def _fill_polygon(self, pixels: np.ndarray, corners: np.ndarray, color: str, scale: float) -> None:
        """Fill a polygon with the corners [N, 2], world (x, z), by the even-odd rule."""
        middle = corners.mean(axis=0)
        rows, columns = self._window(pixels, middle, float(np.abs(corners - middle).max()), scale)
        x, z = self._pixel_places(rows, columns, scale)
        x, z = x[None, :], z[:, None]
        is_inside = np.zeros((z.size, x.size), bool)
        for (x1, z1), (x2, z2) in zip(corners, np.roll(corners, 1, axis=0), strict=True):
            # Edges whose crossing with the pixel's row lies to the right of the pixel.
            if z1 != z2:
                is_inside ^= ((z1 > z) != (z2 > z)) & (x < (x2 - x1) * (z - z1) / (z2 - z1) + x1)
        _blend(pixels[rows, columns], is_inside, color, 1.0)


class SceneRenderers:
    """Renderers of the scenes of a bank, made when they are first used."""

    def __init__(self, scenes: Scenes, names: Sequence[str], task: Task) -> None:
        """Prepare.

        Args:
          scenes: the scenes that were compiled.
          names: names of the scenes of the bank, in the same order; the bank lacks scenes without a goal.
          task: categories and rules.
        """
        self._scenes = scenes
        self._names = names
        self._task = task
        self._renderers: dict[int, SceneRenderer] = {}

    def __getitem__(self, index: int) -> SceneRenderer:
        if index not in self._renderers:
            scene_index = index
            while self._scenes[scene_index].name != self._names[index]:
                scene_index += 1
            self._renderers[index] = SceneRenderer(self._scenes[scene_index], self._task)
        return self._renderers[index]


def _blend(pixels: np.ndarray, mask: np.ndarray, color: str, opacity: float) -> None:
    """Blend a color into the pixels [height, width, 3] under a mask, in place."""
    tint = 255 * opacity * parse_color(color).astype(np.float32)
    pixels[mask] = np.rint(pixels[mask] * np.float32(1 - opacity) + tint).astype(np.uint8)
