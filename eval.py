"""Evaluate a run with and without soft Total Direct Effect: `python eval.py RUN`."""

import sys

from jaxnav.cli.eval import main

if __name__ == "__main__":
    sys.exit(main(prog="eval.py"))
