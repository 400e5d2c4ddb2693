"""What removals do in a mixed population, as records."""

import dataclasses
from collections.abc import Mapping

from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.codec import OPTIONAL

#: A measure at each shift.
ByShift = tuple[Interval, ...]


@dataclasses.dataclass(frozen=True)
class Compared:
    """Hold what a removal gains on a control.

    Attributes:
      weight: of the control, at each shift.
      gained: the removal less the control over all episodes, by metric, in percentage points.
    """

    weight: tuple[float, ...]
    gained: Mapping[str, Interval]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Removal:
    """Hold what one way of removing experience does.

    All by metric, in percentage points, but for shares, in percent.

    Attributes:
      name: what is removed, and when.
      weight: mean weight of what is taken out, at each shift.
      change: against the same policies without removal, at each shift.
      mixture: the same over all episodes.
      left: share of the lead over the agent without experience that is left, at each shift: of a value what is kept;
        100 less it is what is recovered of a cost. NaN where the lead is not clear of 0.
      compared: with each control, by name; None for what is a control itself.
    """

    name: str
    weight: tuple[float, ...]
    change: Mapping[str, ByShift]
    mixture: Mapping[str, Interval]
    left: Mapping[str, ByShift]
    compared: Mapping[str, Compared] | None = dataclasses.field(default=None, metadata=OPTIONAL)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mixture:
    """Hold the accounting of a run, and every removal.

    Attributes:
      run: its name.
      decoding: of actions.
      world: name of the world.
      shifts: of the layout, one part of the population each.
      scenes, episodes: their numbers at each shift.
      length: median length of the episodes without removal, at each shift.
      without: agents that cannot know any layout, by metric, at each shift.
      agent: without removal.
      lead: of the agent on them.
      removals: of experience.
      heir: name of the run that removal hands over to; None where it leaves the run's own direct effect.
    """

    run: str
    decoding: Decoding
    world: str
    shifts: tuple[float, ...]
    scenes: int
    episodes: int
    length: tuple[float, ...]
    without: Mapping[str, ByShift]
    agent: Mapping[str, ByShift]
    lead: Mapping[str, ByShift]
    removals: tuple[Removal, ...]
    heir: str | None = dataclasses.field(default=None, metadata=OPTIONAL)

    def removal(self, name: str) -> Removal:
        """Return a removal by its name.

        Raises:
          KeyError: there is none.
        """
        for removal in self.removals:
            if removal.name == name:
                return removal
        raise KeyError(f"{self.run}: no removal {name!r}")
