"""The scene file and importers of other formats."""
