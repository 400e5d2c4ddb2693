"""An episode played by hand, in the terminal."""
