"""Campaign folder on disk: config, files, and stored stages.

`config` defines the schema of config.yaml, flights.tsv, segments.tsv and clocks.tsv. `folder.Campaign` returns the
paths of all files. `store` writes and reads stages with their manifests. `digests` hashes files. The package imports
only lower layers, does not depend on the rules of the workflow, and does not compute pixels.
"""
