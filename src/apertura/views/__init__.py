"""User interface: the command line, the report, the map, inspection of files, verification of products.

The package imports every layer of the product; only the command `apertura` and the workflow's Snakefile import it.
"""
