"""Evaluate a run with and without soft Total Direct Effect: `python eval.py RUN`.

`python eval.py instrument RUN` checks that the layout shift leaves the difficulty as it is and costs the baseline.
`python eval.py study` tests the paper's claims.
"""

import sys

from jaxnav.cli import eval as evaluation
from jaxnav.cli import study

if __name__ == "__main__":
    other_commands = {"instrument": study.instrument_main, "study": study.main}
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in other_commands:
        sys.exit(other_commands[name](sys.argv[2:], prog=f"eval.py {name}"))
    sys.exit(evaluation.main(prog="eval.py"))
