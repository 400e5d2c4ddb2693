"""Train a method with and without the layout estimator: `python train.py --help`."""

import sys

from jaxnav.cli.train import main

if __name__ == "__main__":
    sys.exit(main(prog="train.py"))
