"""User interface: plan, summary, report, map, inspection of files, and verification of products.

The package imports all layers of the product. Only the command `apertura` and the workflow's Snakefile import the
package.
"""
