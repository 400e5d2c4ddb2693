"""Evaluate a run with and without soft Total Direct Effect: `python eval.py RUN`.

`python eval.py instrument RUN` proves the instrument: that the dial shifts layouts and leaves the difficulty.
"""

import sys

from jaxnav.cli import eval as evaluation
from jaxnav.cli import instrument

if __name__ == "__main__":
    if sys.argv[1:2] == ["instrument"]:
        sys.exit(instrument.main(sys.argv[2:]))
    sys.exit(evaluation.main())
