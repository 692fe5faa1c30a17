"""Studies of what apertura can do: the paper's figures, stability, refinement, the error atlas.

A distribution of its own, for who develops or judges methods: `make setup` installs it, ``pip install apertura`` does
not. Imports every layer of apertura; nothing of apertura imports it. `apertura study` comes with it, by an entry point
of group ``apertura.commands``.
"""
