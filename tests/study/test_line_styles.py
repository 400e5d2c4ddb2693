"""Lines of the figures can be told apart in grey."""

import numpy as np

from jaxnav.study.figures import LINE_STYLES


def test_neighbouring_styles_differ_in_grey():
    rgb = [[int(style["color"][i : i + 2], 16) for i in (1, 3, 5)] for style in LINE_STYLES]
    grey = np.array(rgb) @ (0.299, 0.587, 0.114)
    assert (np.abs(np.diff(grey[:4])) > 35).all()
    assert len({style["marker"] for style in LINE_STYLES}) == len(LINE_STYLES)
