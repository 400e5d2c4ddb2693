"""Numbers as the paper prints them: Tables 1 to 3 of Zhang et al., CVPR 2023."""

from collections.abc import Mapping
from typing import NamedTuple


class Printed(NamedTuple):
    """Hold one row of a table.

    Attributes:
      sr, spl: percent.
      dts: metres.
    """

    sr: float
    spl: float
    dts: float


#: An agent: a method, and how its policies are used. Methods with the layout have sTDE in Tables 2 and 3.
Agent = tuple[str, str]
#: Ablation of ORG, AI2-THOR, val.
TABLE_1: Mapping[Agent, Printed] = {
    ("org", "baseline"): Printed(66.48, 38.42, 0.54),
    ("org", "layout"): Printed(71.40, 39.11, 0.49),
    ("org", "tde"): Printed(69.24, 38.38, 0.52),
    ("org", "stde"): Printed(74.95, 41.68, 0.47),
}
_TABLE_2: Mapping[Agent, tuple[Printed, Printed]] = {
    ("random", "random"): (Printed(4.68, 2.42, 1.36), Printed(2.92, 1.34, 2.40)),
    ("rgb", "baseline"): (Printed(59.06, 34.56, 0.68), Printed(27.48, 16.45, 2.08)),
    ("sp", "baseline"): (Printed(62.19, 37.60, 0.61), Printed(26.22, 16.90, 2.06)),
    ("savn", "baseline"): (Printed(63.27, 38.20, 0.56), Printed(28.53, 18.27, 1.96)),
    ("eotp", "baseline"): (Printed(65.61, 38.93, 0.55), Printed(28.84, 18.82, 1.95)),
    ("org", "baseline"): (Printed(66.53, 39.00, 0.54), Printed(29.64, 19.13, 1.95)),
    ("tpn", "baseline"): (Printed(68.60, 39.40, 0.54), Printed(30.05, 19.05, 1.89)),
    ("vtnet", "baseline"): (Printed(70.10, 39.60, 0.52), Printed(31.62, 19.63, 1.87)),
    ("hoz", "baseline"): (Printed(70.38, 39.04, 0.48), Printed(32.27, 20.48, 1.85)),
    ("eotp", "stde"): (Printed(69.62, 40.02, 0.52), Printed(37.37, 22.00, 1.81)),
    ("org", "stde"): (Printed(74.85, 41.56, 0.47), Printed(39.27, 22.81, 1.77)),
    ("vtnet", "stde"): (Printed(75.25, 41.69, 0.47), Printed(41.53, 23.87, 1.72)),
    ("hoz", "stde"): (Printed(75.05, 41.53, 0.46), Printed(42.13, 24.54, 1.67)),
}
#: AI2-THOR, test.
TABLE_2_AI2THOR: Mapping[Agent, Printed] = {agent: printed for agent, (printed, _) in _TABLE_2.items()}
#: RoboTHOR, test.
TABLE_2_ROBOTHOR: Mapping[Agent, Printed] = {agent: printed for agent, (_, printed) in _TABLE_2.items()}
#: Gibson, val; its RGBD+RL is `rgb`, whose view of the floor is what depth would give. Random's 0.04 looks like a
#: fraction among percentages.
TABLE_3: Mapping[Agent, Printed] = {
    ("random", "random"): Printed(0.04, 0.04, 3.89),
    ("rgb", "baseline"): Printed(8.42, 2.87, 3.23),
    ("semexp", "baseline"): Printed(65.35, 33.52, 1.56),
    ("semexp", "stde"): Printed(66.96, 34.33, 1.53),
}
