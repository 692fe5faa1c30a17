"""A campaign folder from its config to its products.

Offers one function per rule of the workflow (`steps`), what each result is made from (`lineage`), what files say of
themselves (`examination`), and what is wrong with a campaign before it runs (`check`). Imports the layers below; shows
nothing to people but lines of a log.
"""
