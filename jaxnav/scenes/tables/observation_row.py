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

    def pack(self, detections: Any, view: Any) -> Any:
        """Pack detections and views into rows.

        Args:
          detections: uint8 [..., K, 4], confidence, ahead, right and apparent size.
          view: uint8 [..., V, V], ego-centric views.

        Returns:
          uint8 [..., num_bytes].
        """
        xp, poses = view.__array_namespace__(), view.shape[:-2]

        def zeros(number: int) -> Any:
            return xp.zeros((*poses, number), dtype=np.uint8)

        cells = xp.concat(
            [view.reshape(*poses, self.view * self.view), zeros(4 * self._view_bytes - self.view * self.view)], axis=-1
        )
        groups = cells.reshape(*poses, self._view_bytes, 4)
        packed = xp.sum(groups << _shifts(groups.ndim), axis=-1, dtype=np.uint8)
        rest = zeros(self.num_bytes - self._view_at - self._view_bytes)
        return xp.concat([detections.reshape(*poses, self._view_at), packed, rest], axis=-1)

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
        cells = (packed[..., None] >> _shifts(packed.ndim + 1)) & np.uint8(3)
        return cells.reshape(*rows.shape[:-1], -1)[..., : self.view * self.view]


def _shifts(rank: int) -> np.ndarray:
    """Return where the four cells of a byte lie in it, uint8 [1, ..., 1, 4]."""
    return np.array([0, 2, 4, 6], np.uint8).reshape((1,) * (rank - 1) + (4,))
