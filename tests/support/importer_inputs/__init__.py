"""Small inputs, made by hand, of every format."""
