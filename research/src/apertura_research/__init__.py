"""Performance studies of apertura: the paper's figures, stability, refinement and the error atlas.

A separate distribution for developers and reviewers of methods: `make setup` installs it, ``pip install apertura``
does not. It imports every layer of apertura; apertura does not import it. Its entry point of the group
``apertura.commands`` adds the command `apertura study`.
"""
