"""The packed row of a pose: what an agent perceives."""

import dataclasses
from typing import Any

import numpy as np

VIEW_UNKNOWN, VIEW_FREE, VIEW_BLOCKED = range(3)
#: Bytes per metre (ahead), per metre around 128 (right) and per unit of apparent size.
AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE = 51.0, 25.4, 127.5


def relative_position(detections: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return metres ahead and to the right of detections.

    Args:
      detections: [..., 4], confidence, ahead, right and apparent size in bytes.

    Returns:
      float64 [...] each.
    """
    return detections[..., 1] / AHEAD_SCALE, (detections[..., 2] - 128.0) / RIGHT_SCALE


def detected_places(detections: np.ndarray, place: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return where detections from one pose lie, world (x, z).

    Args:
      detections: [..., 4], see `relative_position`.
      place: float64 [2], world (x, z) of the agent.
      forward: float64 [2], unit vector (x, z) of its heading.

    Returns:
      float64 [..., 2].
    """
    ahead, right = relative_position(detections)
    rightward = np.array([forward[1], -forward[0]])
    return place + ahead[..., None] * forward + right[..., None] * rightward


@dataclasses.dataclass(frozen=True)
class RowFormat:
    """Describe the bytes of a row.

    Its methods take NumPy and JAX arrays.

    Attributes:
      num_categories: K.
      view: V, cells along each side of the ego-centric view.
    """

    num_categories: int
    view: int = 11

    @property
    def num_bytes(self) -> int:
        """Return the length of a row, padded to 32-byte lines."""
        return -(-(self._view_at + self._view_bytes) // 32) * 32

    @property
    def _view_at(self) -> int:
        return 4 * self.num_categories

    @property
    def _view_bytes(self) -> int:
        return -(-self.view * self.view // 4)

    def pack(self, detections: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Pack detections and views into rows.

        Args:
          detections: uint8 [P, K, 4], confidence, ahead, right and apparent size.
          view: uint8 [P, V, V], ego-centric views.

        Returns:
          uint8 [P, num_bytes].
        """
        num_poses = len(view)
        rows = np.zeros((num_poses, self.num_bytes), np.uint8)
        rows[:, : self._view_at] = detections.reshape(num_poses, self._view_at)
        cells = np.zeros((num_poses, 4 * self._view_bytes), np.uint8)
        cells[:, : self.view * self.view] = view.reshape(num_poses, self.view * self.view)
        groups = cells.reshape(num_poses, self._view_bytes, 4) << np.array([0, 2, 4, 6], np.uint8)
        rows[:, self._view_at : self._view_at + self._view_bytes] = groups.sum(-1, dtype=np.uint8)
        return rows

    def detections(self, rows: Any) -> Any:
        """Return the detections of rows uint8 [..., num_bytes].

        They are uint8 [..., K, 4], confidence, ahead, right and apparent size.
        """
        return rows[..., : self._view_at].reshape(*rows.shape[:-1], self.num_categories, 4)

    def presence(self, rows: Any) -> Any:
        """Return which categories are detected, bool [..., K]."""
        return rows[..., 0 : self._view_at : 4] > 0

    def view_cells(self, rows: Any) -> Any:
        """Return the ego-centric view, uint8 [..., V * V].

        Row 0 is nearest to the agent, column 0 leftmost.
        """
        packed = rows[..., self._view_at : self._view_at + self._view_bytes]
        shifts = np.array([0, 2, 4, 6], np.uint8).reshape((1,) * packed.ndim + (4,))
        cells = (packed[..., None] >> shifts) & np.uint8(3)
        return cells.reshape(*rows.shape[:-1], -1)[..., : self.view * self.view]
