"""From files of simulators and datasets to scenes: one module per format, each a function that yields them one by one.

Every importer is a generator of `Scene` or, for a scene that cannot be used, the `InputError` that says why. A file
that cannot be read at all raises its `InputError`.
"""
