"""A campaign folder from its config to its products: config, campaign, lineage, opening, steps, store, check, runs.

Offers one function per rule of the workflow (`steps`), what each result is made from (`lineage`), and what is wrong
with a campaign before it runs (`check`). Imports the layers below; shows nothing to people but lines of a log.
"""
