"""A small input of every format that the import command reads, made by hand."""
