"""Evaluate a run with and without soft Total Direct Effect: `python eval.py RUN`.

`python eval.py instrument RUN` proves the instrument: that the dial shifts layouts and leaves the difficulty.
`python eval.py study` puts the paper's claims to the test.
"""

import sys

from jaxnav.cli import eval as evaluation
from jaxnav.cli import instrument, study

if __name__ == "__main__":
    others = {"instrument": instrument.main, "study": study.main}
    if sys.argv[1:2] and sys.argv[1] in others:
        sys.exit(others[sys.argv[1]](sys.argv[2:], prog=f"eval.py {sys.argv[1]}"))
    sys.exit(evaluation.main(prog="eval.py"))
