"""Sites of drawn scenes."""

from jaxnav.baselines.sites import Sites, find_sites
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Rules, Task
from support.scenes import CATEGORIES, ROOMS


def find_perfect_sites(scene: Scene, rules: Rules = ROOMS) -> Sites:
    """Return the sites of a scene for a detector without errors.

    The scene has S sites, K = 3 categories and P poses: `object_sites` is bool [K, S], `relations` bool [3, S, S],
    `surroundings` float32 [3, S] and `detected_site` int [P, K], -1 where nothing is detected.
    """
    task = Task(CATEGORIES, rules=rules, detector=PERFECT_DETECTOR)
    return find_sites(scene, task, compile_scene(scene, task).rows)
