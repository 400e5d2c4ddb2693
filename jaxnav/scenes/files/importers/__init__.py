"""Importers of scenes, one module per family of formats.

Every importer is a generator. It yields a `Scene` or, for a scene that cannot be used, the `InputError` that says why.
A file that cannot be read at all raises an `InputError`. After a scene may come `ImportNote`s about guesses and other
changes.
"""
