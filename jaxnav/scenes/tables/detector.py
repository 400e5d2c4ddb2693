"""The simulated object detector, with errors fixed per pose."""

import dataclasses
import zlib

import numpy as np

from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE

MIN_RANGE, MAX_RANGE = 1.5, 5.0
ALARM_SIZE = 0.3
SMALLEST_APPARENT_SIZE = 0.12  # about 15 pixels of a 300 x 300 picture with a field of view of 100 degrees


@dataclasses.dataclass(frozen=True)
class Detector:
    """Describe a detector by error rates in [0, 1].

    Attributes:
      miss_near: probability of missing an object right in front.
      miss_far: probability of missing an object at the end of its range.
      false_alarm: probability per pose and undetected category of reporting it anyway.
      seed: draws the errors, together with the scene's name.
    """

    miss_near: float = 0.05
    miss_far: float = 0.4
    false_alarm: float = 0.005
    seed: int = 0

    def detect(
        self,
        name: str,
        half_view: float,
        seen: np.ndarray,
        ahead: np.ndarray,
        right: np.ndarray,
        distance: np.ndarray,
        size: np.ndarray,
    ) -> np.ndarray:
        """Return the detections of one scene, with errors.

        Args:
          name: the scene's name; its errors do not depend on the other scenes of a bank.
          half_view: tangent of half the horizontal field of view.
          seen: bool [P, K], whether a detector without errors detects a category.
          ahead, right, distance, size: float [P, K], metres, of the nearest detected object.

        Returns:
          uint8 [P, K, 4]: confidence, ahead, right and apparent size, all 0 where nothing is detected.
        """
        generator = np.random.default_rng([self.seed, zlib.crc32(name.encode())])
        chance, noise, place, bearing = generator.random((4, *seen.shape), dtype=np.float32)
        nearness = np.clip(distance / detection_range(size), 0.0, 1.0)
        missed = chance < self.miss_near + (self.miss_far - self.miss_near) * nearness**2
        alarm = ~seen & (chance < self.false_alarm)
        noisy = self.miss_near > 0 or self.miss_far > 0 or self.false_alarm > 0
        confidence = 1.0 - 0.5 * nearness + (0.2 * (noise - 0.5) if noisy else 0.0)
        confidence = np.where(alarm, 0.3 + 0.3 * noise, confidence)

        # A false alarm stands uniformly in the part of the view cone where an object of its size could be detected.
        away = detection_range(ALARM_SIZE) * np.sqrt(place)
        angle = np.arctan(half_view) * (2.0 * bearing - 1.0)
        ahead, right = np.where(alarm, away * np.cos(angle), ahead), np.where(alarm, away * np.sin(angle), right)
        apparent = np.where(alarm, ALARM_SIZE, size) / np.maximum(np.hypot(ahead, right), 0.25)

        reported = (seen & ~missed) | alarm
        return np.where(reported[..., None], _bytes(confidence, ahead, right, apparent), 0.0).astype(np.uint8)


#: A detector without errors.
PERFECT = Detector(miss_near=0.0, miss_far=0.0, false_alarm=0.0)


def object_size(boxes: np.ndarray) -> np.ndarray:
    """Return the size of boxes [N, 6], float64 [N], metres.

    It is the root of the product of the two largest sides.
    """
    sides = np.sort(boxes[:, 3:], axis=1)
    return np.sqrt(sides[:, 1] * sides[:, 2])


def detection_range(size: np.ndarray | float) -> np.ndarray:
    """Return the greatest distance at which objects are detected.

    Args:
      size: of the objects, metres, see `object_size`.

    Returns:
      Of the shape of `size`, metres.
    """
    return np.clip(size / SMALLEST_APPARENT_SIZE, MIN_RANGE, MAX_RANGE)


def _bytes(confidence: np.ndarray, ahead: np.ndarray, right: np.ndarray, apparent: np.ndarray) -> np.ndarray:
    """Scale detections to the range of bytes, float64 [..., 4]."""
    channels = (
        np.maximum(np.rint(255.0 * np.clip(confidence, 0.0, 1.0)), 1.0),
        np.rint(AHEAD_SCALE * ahead),
        128.0 + np.rint(RIGHT_SCALE * right),
        np.rint(SIZE_SCALE * apparent),
    )
    return np.clip(np.stack(channels, axis=-1), 0.0, 255.0)
