"""Observation rows: the packed bytes that an agent perceives at one pose, and the simulated detector behind them.

A row holds the detection of each category and an ego-centric view of the floor. `RowFormat` packs and unpacks rows, on
NumPy and on JAX arrays. `Detector` simulates an object detector, whose errors are sampled once per pose.

A detection has four bytes: confidence, metres ahead, metres to the right and apparent size, all 0 for an undetected
category. `relative_position` converts the bytes of the position to metres. Rows may also hold the number of detected
instances of each category, for layout estimators that count instances.
"""

import dataclasses
import zlib
from typing import Any

import numpy as np

#: Cell of the ego-centric view that is hidden or beyond the view cone.
VIEW_UNKNOWN = 0
#: Visible standable cell of the ego-centric view.
VIEW_FREE = 1
#: Visible cell of the ego-centric view on which the agent cannot stand.
VIEW_BLOCKED = 2

#: Byte steps per metre ahead.
AHEAD_SCALE = 51.0
#: Byte steps per metre to the right, and the byte of 0 m.
RIGHT_SCALE = 25.4
RIGHT_ORIGIN = 128.0
#: Byte steps per unit of apparent size.
SIZE_SCALE = 127.5

#: Detection range of the smallest objects, metres.
MIN_RANGE = 1.5
#: Detection range of the largest objects, metres.
MAX_RANGE = 5.0
#: Size of the objects that false alarms report, metres.
FALSE_ALARM_SIZE = 0.3
# Confidence of a detection: loss at the end of the range, width of its noise; least value and width of false alarms.
_CONFIDENCE_LOSS = 0.5
_CONFIDENCE_NOISE = 0.2
_MIN_ALARM_CONFIDENCE = 0.3
_ALARM_CONFIDENCE_RANGE = 0.3
# Nearer objects look no larger, metres.
_MIN_DISTANCE = 0.25
#: Apparent size of an object at the end of its detection range: about 15 pixels of a 300 x 300 picture with a field of
#: view of 100 degrees.
MIN_APPARENT_SIZE = 0.12


@dataclasses.dataclass(frozen=True)
class RowFormat:
    """Layout of the bytes of a row: detections, the view at two bits per cell, instance counts if any, padding.

    All methods accept NumPy and JAX arrays. Detections and view have the same places with and without counts, so a
    format without counts reads them from rows of either kind.

    Attributes:
      num_categories: K.
      view: V, cells along each side of the ego-centric view.
      has_counts: whether rows hold the number of detected instances of each category.
    """

    num_categories: int
    view: int = 11
    has_counts: bool = False

    @property
    def num_bytes(self) -> int:
        """Length of a row, padded to a multiple of 32 bytes."""
        return -(-(self._counts_start + self._counts_bytes) // 32) * 32

    @property
    def _view_start(self) -> int:
        return 4 * self.num_categories

    @property
    def _view_bytes(self) -> int:
        return -(-self.view * self.view // 4)

    @property
    def _counts_start(self) -> int:
        return self._view_start + self._view_bytes

    @property
    def _counts_bytes(self) -> int:
        return self.num_categories if self.has_counts else 0

    def pack(self, detections: Any, view: Any, counts: Any = None) -> Any:
        """Pack detections and views, and instance counts if the rows hold them, into rows.

        Args:
          detections: uint8 [..., K, 4].
          view: uint8 [..., V, V], ego-centric views.
          counts: uint8 [..., K], detected instances of each category; None without counts.

        Returns:
          uint8 [..., num_bytes].

        Raises:
          ValueError: the rows hold counts, and none are given, or the reverse.
        """
        if self.has_counts != (counts is not None):
            raise ValueError("counts: give instance counts exactly for rows that hold them (has_counts)")

        # Four cells of the view share a byte.
        xp = view.__array_namespace__()
        batch_shape = view.shape[:-2]
        num_cells = self.view * self.view
        cell_padding = xp.zeros((*batch_shape, 4 * self._view_bytes - num_cells), dtype=np.uint8)
        cells = xp.concat([view.reshape(*batch_shape, num_cells), cell_padding], axis=-1)
        cell_groups = cells.reshape(*batch_shape, self._view_bytes, 4)
        packed_view = xp.sum(cell_groups << _cell_shifts(cell_groups.ndim), axis=-1, dtype=np.uint8)

        # Detections, view, counts and padding, one after another.
        parts = [detections.reshape(*batch_shape, self._view_start), packed_view]
        if counts is not None:
            parts.append(counts)
        num_padding = self.num_bytes - self._counts_start - self._counts_bytes
        parts.append(xp.zeros((*batch_shape, num_padding), dtype=np.uint8))
        return xp.concat(parts, axis=-1)

    def detections(self, rows: Any) -> Any:
        """Return the detections in rows uint8 [..., num_bytes], uint8 [..., K, 4]."""
        return rows[..., : self._view_start].reshape(*rows.shape[:-1], self.num_categories, 4)

    def presence(self, rows: Any) -> Any:
        """Return True for the categories that are detected, bool [..., K]."""
        return rows[..., 0 : self._view_start : 4] > 0

    def counts(self, rows: Any) -> Any:
        """Return the number of detected instances of each category, uint8 [..., K].

        Raises:
          ValueError: the rows hold no counts.
        """
        if not self.has_counts:
            raise ValueError("counts: these rows hold no instance counts; compile the scenes with instance counts")
        return rows[..., self._counts_start : self._counts_start + self.num_categories]

    def view_cells(self, rows: Any) -> Any:
        """Return the ego-centric view, uint8 [..., V * V].

        Row 0 of the view is nearest to the agent, column 0 leftmost.
        """
        packed_view = rows[..., self._view_start : self._counts_start]
        cells = (packed_view[..., None] >> _cell_shifts(packed_view.ndim + 1)) & np.uint8(3)
        return cells.reshape(*rows.shape[:-1], -1)[..., : self.view * self.view]


def _cell_shifts(rank: int) -> np.ndarray:
    """Return the bit positions of the four cells of a byte, uint8 [1, ..., 1, 4]."""
    return np.array([0, 2, 4, 6], np.uint8).reshape((1,) * (rank - 1) + (4,))


def relative_position(detections: Any) -> tuple[Any, Any]:
    """Return metres ahead and metres to the right of detections.

    Args:
      detections: uint8 [..., 4] of NumPy, or the bytes as a float32 array of JAX.

    Returns:
      float [...] each; float64 for bytes, else of the type of the array.
    """
    return detections[..., 1] / AHEAD_SCALE, (detections[..., 2] - RIGHT_ORIGIN) / RIGHT_SCALE


def turn_offsets(ahead: Any, right: Any, forward: Any) -> Any:
    """Return the world offsets of places ahead and to the right of an agent, arrays of NumPy or JAX.

    Args:
      ahead, right: float [...], metres or cells.
      forward: float [..., 2], unit vector (x, z) of the agent's heading; arrays of JAX with as many axes as the result.

    Returns:
      float [..., 2], world (x, z), in the unit of `ahead`.
    """
    # Headings turn clockwise from +z, so the right of (x, z) is (z, -x).
    signs = np.array([1.0, -1.0], forward.dtype).reshape((1,) * (forward.ndim - 1) + (2,))
    rightward = forward[..., ::-1] * signs
    return ahead[..., None] * forward + right[..., None] * rightward


def detected_positions(detections: np.ndarray, agent_position: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the world positions of detections from one pose.

    Args:
      detections: uint8 [..., 4].
      agent_position: float64 [2], world (x, z).
      forward: float64 [2], unit vector (x, z) of the agent's heading.

    Returns:
      float64 [..., 2], world (x, z).
    """
    ahead, right = relative_position(detections)
    return agent_position + turn_offsets(ahead, right, forward)


@dataclasses.dataclass(frozen=True)
class Detector:
    """Simulated object detector and its errors.

    Attributes:
      miss_near: probability of missing an object directly in front of the agent, from 0 to 1.
      miss_far: probability of missing an object at the end of its detection range, from 0 to 1.
      false_alarm: probability of a false detection for each pose and category, from 0 to 1.
      seed: random seed of the errors, from 0 to 4,294,967,295; combined with the name of the scene.
    """

    miss_near: float = 0.05
    miss_far: float = 0.4
    false_alarm: float = 0.005
    seed: int = 0

    def detect(
        self,
        scene_name: str,
        half_view_tangent: float,
        visible: np.ndarray,
        ahead: np.ndarray,
        right: np.ndarray,
        distance: np.ndarray,
        size: np.ndarray,
    ) -> np.ndarray:
        """Sample the detections of one scene, with errors.

        Args:
          scene_name: name of the scene, which seeds the errors, so that they do not depend on the bank of the scene.
          half_view_tangent: tangent of half the horizontal field of view.
          visible: bool [P, K], True where a perfect detector detects a category.
          ahead: float [P, K], metres ahead to the nearest visible object.
          right: float [P, K], metres to the right to the nearest visible object.
          distance: float [P, K], distance of the nearest visible object, metres.
          size: float [P, K], size of the nearest visible object, metres.

        Returns:
          uint8 [P, K, 4].
        """
        # Independent errors for each pose and category, seeded by the scene.
        rng = np.random.default_rng([self.seed, zlib.crc32(scene_name.encode())])
        error_draw, noise, range_draw, bearing_draw = rng.random((4, *visible.shape), dtype=np.float32)

        # Misses become more likely with distance; false alarms only occur without a visible object.
        relative_distance = _relative_distance(distance, size)
        is_missed = error_draw < self._miss_probability(relative_distance)
        is_false_alarm = ~visible & (error_draw < self.false_alarm)
        has_errors = self.miss_near > 0 or self.miss_far > 0 or self.false_alarm > 0
        confidence = (
            1.0 - _CONFIDENCE_LOSS * relative_distance + (_CONFIDENCE_NOISE * (noise - 0.5) if has_errors else 0.0)
        )
        confidence = np.where(is_false_alarm, _MIN_ALARM_CONFIDENCE + _ALARM_CONFIDENCE_RANGE * noise, confidence)

        # A false alarm lies uniformly in the part of the view cone where an object of its size could be detected.
        alarm_distance = detection_range(FALSE_ALARM_SIZE) * np.sqrt(range_draw)
        alarm_angle = np.arctan(half_view_tangent) * (2.0 * bearing_draw - 1.0)
        ahead = np.where(is_false_alarm, alarm_distance * np.cos(alarm_angle), ahead)
        right = np.where(is_false_alarm, alarm_distance * np.sin(alarm_angle), right)
        size = np.where(is_false_alarm, FALSE_ALARM_SIZE, size)
        apparent_size = size / np.maximum(np.hypot(ahead, right), _MIN_DISTANCE)

        # Bytes are 0 for undetected categories.
        is_detected = (visible & ~is_missed) | is_false_alarm
        detection_bytes = _scale_to_bytes(confidence, ahead, right, apparent_size)
        return np.where(is_detected[..., None], detection_bytes, 0.0).astype(np.uint8)

    def count(
        self,
        scene_name: str,
        is_detected: np.ndarray,
        pose: np.ndarray,
        category: np.ndarray,
        distance: np.ndarray,
        size: np.ndarray,
    ) -> np.ndarray:
        """Sample how many instances of each category are detected, with errors.

        A detected category counts one for its detection, false alarms included, and one for every further visible
        instance that is not missed. Each instance is missed with the probability of its own distance and size.

        Args:
          scene_name: name of the scene, which seeds the errors.
          is_detected: bool [P, K], True where the category is detected (see `detect`).
          pose, category: int [M], pose and category of each visible instance but the nearest ones, which `detect`
            decides about.
          distance, size: float [M], distance and size of these instances, metres.

        Returns:
          uint8 [P, K], 0 exactly where nothing is detected; more than 255 instances count 255.
        """
        # A random stream of its own leaves the errors of the detections unchanged.
        rng = np.random.default_rng([self.seed, zlib.crc32(scene_name.encode()), 1])
        error_draw = rng.random(len(pose), dtype=np.float32)
        is_counted = error_draw >= self._miss_probability(_relative_distance(distance, size))

        counts = np.ones(is_detected.shape, np.int64)
        np.add.at(counts, (pose[is_counted], category[is_counted]), 1)
        return np.where(is_detected, np.minimum(counts, 255), 0).astype(np.uint8)

    def _miss_probability(self, relative_distance: np.ndarray) -> np.ndarray:
        """Return the probability of missing an object at a distance relative to its detection range."""
        return self.miss_near + (self.miss_far - self.miss_near) * relative_distance**2


#: A detector without errors.
PERFECT_DETECTOR = Detector(miss_near=0.0, miss_far=0.0, false_alarm=0.0)


def object_size(boxes: np.ndarray) -> np.ndarray:
    """Return the size of boxes [N, 6], the geometric mean of their two largest sides, float64 [N], metres."""
    side_lengths = np.sort(boxes[:, 3:], axis=1)
    return np.sqrt(side_lengths[:, 1] * side_lengths[:, 2])


def detection_range(size: np.ndarray | float) -> np.ndarray:
    """Return the greatest distance at which objects are detected.

    Args:
      size: float [...], sizes of the objects, metres, see `object_size`.

    Returns:
      float [...], metres.
    """
    return np.clip(size / MIN_APPARENT_SIZE, MIN_RANGE, MAX_RANGE)


def _relative_distance(distance: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return distances relative to the detection ranges of objects, from 0 to 1."""
    return np.clip(distance / detection_range(size), 0.0, 1.0)


def _scale_to_bytes(
    confidence: np.ndarray, ahead: np.ndarray, right: np.ndarray, apparent_size: np.ndarray
) -> np.ndarray:
    """Scale detections to whole numbers in [0, 255], float64 [..., 4]; confidence is at least 1."""
    byte_channels = (
        np.maximum(np.rint(255.0 * np.clip(confidence, 0.0, 1.0)), 1.0),
        np.rint(AHEAD_SCALE * ahead),
        RIGHT_ORIGIN + np.rint(RIGHT_SCALE * right),
        np.rint(SIZE_SCALE * apparent_size),
    )
    return np.clip(np.stack(byte_channels, axis=-1), 0.0, 255.0)
